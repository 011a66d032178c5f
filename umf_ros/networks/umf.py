"""UMF: unifying local and global multimodal features [UMF 4]."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from umf_ros.networks.config import NetworkConfig, NetworkInput
from umf_ros.networks.efficientnet import SceneDescriptor
from umf_ros.networks.encoders import CELLS, ImageEncoder, VoxelEncoder
from umf_ros.networks.fusion import (
    AbsentToken,
    Fused,
    Fusion,
    Tokens,
    VoxelPositions,
    cell_positions,
    sine_encoding,
)
from umf_ros.networks.local_features import CloudLocal, ImageLocal, IterativeAttention, LocalMap, SuperMap


@dataclass(frozen=True, slots=True)
class Features:
    """Features of the encoders, before fusion.

    Attributes:
        image, cloud: tokens for fusion, positions included.
        fine_image: (B, C, H/4, W/4).
        fine_cloud: (B, V, C).
        scene: (B, S), scene descriptors, longer for unfamiliar views; None without this part.
        scene_map: (B, C, H/16, W/16), the map that they are pooled from; None without this part.
    """

    image: Tokens
    cloud: Tokens
    fine_image: Tensor
    fine_cloud: Tensor
    scene: Tensor | None = None
    scene_map: Tensor | None = None


@dataclass(frozen=True, slots=True)
class NetworkOutput:
    """Output of the network for a batch.

    Attributes:
        descriptor: (B, D) float32, L2-normalised.
        image, cloud: local features.
        super_image, super_cloud: super-features, on request.
        scan_tokens: (B, T, C), tokens of the scan before fusion, without their positions.
        scene_map: (B, C, H/16, W/16), deepest map of the scene descriptor's trunk; None without this part.
    """

    descriptor: Tensor
    image: LocalMap
    cloud: LocalMap
    scan_tokens: Tensor
    super_image: SuperMap | None = None
    super_cloud: SuperMap | None = None
    scene_map: Tensor | None = None


class UMF(nn.Module):
    """Two encoders, a fusion transformer for the global descriptor, heads for local and super-features."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.image_encoder = ImageEncoder(config)
        self.voxel_encoder = VoxelEncoder(config)
        self.scene = SceneDescriptor(config.scene) if config.scene else None
        # normalised, as content and position need the same scale
        self.image_tokens, self.cloud_tokens = nn.LayerNorm(config.tokens), nn.LayerNorm(config.tokens)
        self.fusion = Fusion(config)
        self.absent_image, self.absent_cloud = AbsentToken(config.tokens), AbsentToken(config.tokens)
        self.image_local, self.cloud_local = ImageLocal(config), CloudLocal(config)
        self.super_image = IterativeAttention(config.local, *config.image_supers, config.super_iterations)
        self.super_cloud = IterativeAttention(config.local, *config.cloud_supers, config.super_iterations)
        self.cells: Tensor
        height, width = config.image_size
        cells = sine_encoding(cell_positions(height // 16, width // 16), config.tokens)
        self.register_buffer("cells", cells, persistent=False)
        self.coarse_voxels = VoxelPositions(CELLS // 4, config.tokens)
        self.voxels = VoxelPositions(CELLS, config.local)

    def encode(self, batch: NetworkInput) -> Features:
        """Run the encoders and add the positions to the tokens."""
        image, fine_image = self.encode_image(batch)
        cloud, fine_cloud = self.encode_cloud(batch)
        if self.scene is None:
            return Features(image, cloud, fine_image, fine_cloud)
        scene_map = self.scene.trunk(batch.image)[-1]
        scene = self.scene.project(self.scene.pool_map(scene_map).flatten(1))
        return Features(image, cloud, fine_image, fine_cloud, scene, scene_map)

    def encode_image(self, batch: NetworkInput) -> tuple[Tokens, Tensor]:
        """Return the tokens and the fine features of the images."""
        coarse, fine = self.image_encoder(batch.image)
        tokens = self.image_tokens(coarse.flatten(2).transpose(1, 2))
        tokens = tokens + self.cells.to(tokens.dtype)
        return Tokens(tokens, torch.ones(tokens.shape[:2], dtype=torch.bool, device=tokens.device)), fine

    def encode_cloud(self, batch: NetworkInput) -> tuple[Tokens, Tensor]:
        """Return the tokens and the fine features of the scans."""
        coarse, fine = self.voxel_encoder(batch.grid, batch.coarse_index, batch.fine_index)
        tokens = self.cloud_tokens(coarse)
        return Tokens(tokens + self.coarse_voxels(batch.coarse_index).to(tokens.dtype), batch.coarse_mask), fine

    def fuse(self, features: Features, image_present: Tensor, cloud_present: Tensor) -> Fused:
        """Return descriptors, with the modalities that are present (B,) bool."""
        pooled = self.pool(features, image_present, cloud_present)
        return self.fusion.describe(*pooled, image_present, cloud_present, features.scene)

    def pool(self, features: Features, image_present: Tensor, cloud_present: Tensor) -> tuple[Tensor, Tensor]:
        """Return pooled tokens (B, C) of both modalities, with learned tokens for absent ones ((B,) bool)."""
        image = self.absent_image(features.image, image_present)
        return self.fusion.pool(image, self.absent_cloud(features.cloud, cloud_present))

    def describe_local(self, features: Features, batch: NetworkInput) -> tuple[LocalMap, LocalMap]:
        """Return local features of the images and of the scans."""
        positions = self.voxels(batch.fine_index)
        cloud = self.cloud_local(features.fine_cloud, positions, batch.fine_mask)
        return self.image_local(features.fine_image), cloud

    def forward(self, batch: NetworkInput, super_features: bool = False) -> NetworkOutput:
        """Return all outputs for a batch."""
        features = self.encode(batch)
        fused = self.fuse(features, batch.image_present, batch.coarse_mask.any(1))
        image, cloud = self.describe_local(features, batch)
        supers: tuple[SuperMap | None, SuperMap | None] = (None, None)
        if super_features:
            supers = self.super_image(image.tokens, image.mask), self.super_cloud(cloud.tokens, cloud.mask)
        scan_tokens = features.cloud.values - self.coarse_voxels(batch.coarse_index)
        return NetworkOutput(fused.descriptor, image, cloud, scan_tokens, *supers, scene_map=features.scene_map)


class FlatUmf(nn.Module):
    """The UMF network with tensors as arguments and results.

    Args:
        network: the network.
        outputs: names of the results, as in `umf_ros.embedding.runtimes`.
    """

    def __init__(self, network: UMF, outputs: tuple[str, ...]) -> None:
        super().__init__()
        self.network = network
        self.outputs = outputs

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Map the fields of `NetworkInput`, in their order, to the outputs."""
        found: NetworkOutput = self.network(NetworkInput(*inputs), super_features="super_image" in self.outputs)
        named: dict[str, Any] = {
            "descriptor": found.descriptor,
            "image_local": found.image.descriptors,
            "image_saliency": found.image.saliency,
            "cloud_local": found.cloud.descriptors,
            "cloud_saliency": found.cloud.saliency,
            "scan_tokens": found.scan_tokens,
            "scene_map": found.scene_map,
        }
        for name in ("super_image", "super_cloud"):
            supers = getattr(found, name)
            if supers is not None:
                named |= {name: supers.descriptors, f"{name}_strength": supers.strength}
        return tuple(named[name] for name in self.outputs)


def channels_last(network: nn.Module) -> None:
    """Store the weights of convolutions channels last, which is faster on CPUs (twice in half precision)."""
    for module in network.modules():
        if isinstance(module, nn.Conv2d):
            module.weight.data = module.weight.data.contiguous(memory_format=torch.channels_last)
        elif isinstance(module, nn.Conv3d):
            module.weight.data = module.weight.data.contiguous(memory_format=torch.channels_last_3d)
