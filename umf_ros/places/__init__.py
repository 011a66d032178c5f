"""The place database: keyframes on disk, and the index that finds similar ones."""
