"""UMF: unifying local and global multimodal features [UMF 4]."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

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

Branch = Literal["both", "image", "cloud"]


@dataclass(frozen=True, slots=True)
class Features:
    """Features of the encoders, before fusion.

    Attributes:
        image, cloud: tokens for fusion, positions included.
        fine_image: (B, C, H/4, W/4).
        fine_cloud: (B, V, C).
        scene: (B, S), scene descriptors, longer for unfamiliar views; None without this part.
    """

    image: Tokens
    cloud: Tokens
    fine_image: Tensor
    fine_cloud: Tensor
    scene: Tensor | None = None


@dataclass(frozen=True, slots=True)
class NetworkOutput:
    """Output of the network for a batch.

    Attributes:
        descriptor: (B, D) float32, L2-normalised.
        image, cloud: local features.
        super_image, super_cloud: super-features, on request.
    """

    descriptor: Tensor
    image: LocalMap
    cloud: LocalMap
    super_image: SuperMap | None = None
    super_cloud: SuperMap | None = None


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

    def encode(self, batch: NetworkInput, branch: Branch = "both") -> Features:
        """Run the encoders and add the positions to the tokens; the features of an omitted branch are zero."""
        scene = None
        if branch == "cloud":
            size = batch.image.shape[0]
            scene = None if self.scene is None else batch.image.new_zeros(size, self.config.scene)
            image = batch.image.new_zeros(size, *self.cells.shape)
            fine_image = batch.image.new_zeros(size, self.config.local, *self.image_local.positions.shape[:2])
        else:
            coarse, fine_image = self.image_encoder(batch.image)
            image = self.image_tokens(coarse.flatten(2).transpose(1, 2))
            image = image + self.cells.to(image.dtype)
            scene = None if self.scene is None else self.scene(batch.image)
        everywhere = torch.ones(image.shape[:2], dtype=torch.bool, device=image.device)
        if branch == "image":
            cloud = batch.image.new_zeros(*batch.coarse_index.shape, self.config.tokens)
            fine_cloud = batch.image.new_zeros(*batch.fine_index.shape, self.config.local)
        else:
            cloud, fine_cloud = self.voxel_encoder(batch.grid, batch.coarse_index, batch.fine_index)
            cloud = self.cloud_tokens(cloud)
            cloud = cloud + self.coarse_voxels(batch.coarse_index).to(cloud.dtype)
        return Features(Tokens(image, everywhere), Tokens(cloud, batch.coarse_mask), fine_image, fine_cloud, scene)

    def fuse(self, features: Features, image_present: Tensor, cloud_present: Tensor) -> Fused:
        """Return descriptors, with the modalities that are present (B,) bool."""
        image, cloud = self.stand_in(features, image_present, cloud_present)
        return self.fusion(image, cloud, image_present, cloud_present, features.scene)

    def stand_in(self, features: Features, image_present: Tensor, cloud_present: Tensor) -> tuple[Tokens, Tokens]:
        """Return the tokens of both modalities, with learned tokens for absent ones ((B,) bool)."""
        return self.absent_image(features.image, image_present), self.absent_cloud(features.cloud, cloud_present)

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
        return NetworkOutput(fused.descriptor, image, cloud, *supers)


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
        named: dict[str, Tensor] = {
            "descriptor": found.descriptor,
            "image_local": found.image.descriptors,
            "image_saliency": found.image.saliency,
            "cloud_local": found.cloud.descriptors,
            "cloud_saliency": found.cloud.saliency,
        }
        for name in ("super_image", "super_cloud"):
            supers = getattr(found, name)
            if supers is not None:
                named |= {name: supers.descriptors, f"{name}_strength": supers.strength}
        return tuple(named[name] for name in self.outputs)


def count_parameters(network: nn.Module) -> int:
    """Return the number of trainable parameters."""
    return sum(parameter.numel() for parameter in network.parameters())


def channels_last(network: nn.Module) -> None:
    """Store the weights of convolutions channels last, which is faster on CPUs (twice in half precision)."""
    for module in network.modules():
        if isinstance(module, nn.Conv2d):
            module.weight.data = module.weight.data.contiguous(memory_format=torch.channels_last)
        elif isinstance(module, nn.Conv3d):
            module.weight.data = module.weight.data.contiguous(memory_format=torch.channels_last_3d)
