"""One stage: D = F_H(I_map, I_frame). Paper Eq. (1) and (2)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from .correlation import Lookup, correlation_pyramid, look_up, lookup_coordinates
from .encoder import QuarterEncoder
from .homography import feature_homography, identity_grid
from .update import UpdateBlock


class Matcher(nn.Module):
    """An iterative homography estimator: one encoder for both images, one update block.

    Attribute names are the released keys.
    """

    def __init__(self, resize_width: int, levels: int, iterations: int, lookup: Lookup) -> None:
        super().__init__()
        self.feature_side = resize_width // 4
        self.levels = levels
        self.iterations = iterations
        self.lookup = lookup
        self.fnet1 = QuarterEncoder()
        self.update_block_4 = UpdateBlock(levels, self.feature_side)

    def encode(self, image: Tensor) -> Tensor:
        """`[B, 3, W_R, W_R]` in 0..1 -> `[B, 256, W_R/4, W_R/4]`, for map and frame alike."""
        return self.fnet1(image)

    def match(self, map_features: Tensor, frame_features: Tensor) -> Tensor:
        """`[1 or B, 256, h, w]`, `[B, 256, h, w]` -> cumulative displacements `[K, B, 2, 2, 2]`, input pixels.

        A displacement that makes three corners collinear gives numbers that are not finite, and so does every later
        iteration: the caller sees them (the published code silently drops such an increment).

        Under autocast only convolutions run in half precision, as published: half a correlation or a displacement would
        cost pixels.
        """
        map_features, frame_features = single(map_features), single(frame_features)
        with torch.autocast(frame_features.device.type, enabled=False):
            pyramid = correlation_pyramid(map_features, frame_features, self.levels, self.lookup)
        grid = identity_grid(self.feature_side, frame_features)
        displacement = torch.zeros_like(frame_features[:, :8, 0, 0]).unflatten(1, (2, 2, 2))
        coordinates = grid.expand(frame_features.shape[0], -1, -1, -1)
        cumulative = []
        for iteration in range(self.iterations):
            if iteration > 0:
                coordinates = lookup_coordinates(feature_homography(displacement, self.feature_side), grid, self.lookup)
            # D_{k+1} = D_k + Delta D_k                                                              (2)
            displacement = displacement + single(self.update_block_4(look_up(pyramid, coordinates), coordinates - grid))
            cumulative.append(displacement)
        return torch.stack(cumulative)

    def forward(self, map_image: Tensor, frame_image: Tensor) -> Tensor:
        """Both images `[B, 3, W_R, W_R]` in 0..1 -> `[K, B, 2, 2, 2]`."""
        return self.match(self.encode(map_image), self.encode(frame_image))


def single(x: Tensor) -> Tensor:
    """Half precision made single; anything else as it is."""
    return x.float() if x.dtype in (torch.bfloat16, torch.float16) else x
