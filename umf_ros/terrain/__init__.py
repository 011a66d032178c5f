"""The map of the ground: voxels without moving objects, a grid of where a rover can drive, and their files."""
