"""The light refine stage: patches of the frame, matched in the map by learned features, fitted by weighted least squares.

Coarse to fine, and inside one graph: at every iteration the map's features are warped by the current homography, each
of 8 x 8 patches is correlated with its surroundings, a small network turns the correlations into a shift and a weight
per patch, and the corner displacements follow from the weighted normal equations. Their inverse is the covariance.

Pixels are those of the crop (x right, y down, an integer is a centre). Reference for what it stands in for: Xiao et
al., STHN, RA-L 2024, Sec. III-C, Eq. (4)-(7).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from .layers import Encoder, normalise, standardise_frame

PATCHES = 8


@dataclass(frozen=True)
class Level:
    """One iteration: features pooled by `pool`, searched within +- `radius` of the pooled cells."""

    pool: int
    radius: int


LEVELS = (Level(4, 4), Level(2, 4), Level(1, 3))


def bilinear_basis(points: Tensor, size: float) -> Tensor:
    """Weights of the corners TL, TR, BL, BR of the square 0..size-1 at `points` `[N, 2]` -> `[N, 4]`."""
    u, v = points[:, 0] / (size - 1), points[:, 1] / (size - 1)
    return torch.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v], 1)


def homography_of_square(corners: Tensor, size: float) -> Tensor:
    """The exact homography from the square's corners (0, 0)..(size-1, size-1) to `corners` `[B, 4, 2]`: `[B, 3, 3]`.

    Closed form of Heckbert, Fundamentals of Texture Mapping and Image Warping, 1989, Sec. 2.2.3.
    """
    tl, tr, bl, br = corners.unbind(1)
    d1, d2, s = tr - br, bl - br, tl - tr - bl + br
    det = d1[:, 0] * d2[:, 1] - d2[:, 0] * d1[:, 1]
    g = (s[:, 0] * d2[:, 1] - d2[:, 0] * s[:, 1]) / det
    h = (d1[:, 0] * s[:, 1] - s[:, 0] * d1[:, 1]) / det
    k = 1.0 / (size - 1)
    column0 = torch.cat([tr - tl + g[:, None] * tr, g[:, None]], 1) * k
    column1 = torch.cat([bl - tl + h[:, None] * bl, h[:, None]], 1) * k
    column2 = torch.cat([tl, torch.ones_like(g)[:, None]], 1)
    return torch.stack([column0, column1, column2], 2)


def apply(h: Tensor, points: Tensor) -> Tensor:
    """`[B, 3, 3]` on `[N, 2]` or `[B, N, 2]` -> `[B, N, 2]`."""
    if points.dim() == 2:
        points = points[None]
    x, y = points[..., 0], points[..., 1]
    rows = [h[:, i, 0:1] * x + h[:, i, 1:2] * y + h[:, i, 2:3] for i in range(3)]
    return torch.stack([rows[0] / rows[2], rows[1] / rows[2]], -1)


def gather_bilinear(features: Tensor, points: Tensor) -> Tensor:
    """`[B, C, h, w]` at pixel `points` `[B, N, 2]` -> `[B, C, N]`, zero outside. A gather of rows, not GridSample."""
    b, c, h, w = features.shape
    rows = features.permute(0, 2, 3, 1).reshape(b * h * w, c)
    base = (torch.arange(b, device=features.device) * (h * w))[:, None]
    x0, y0 = points[..., 0].floor(), points[..., 1].floor()
    out = None
    for dy in (0, 1):
        for dx in (0, 1):
            x, y = x0 + dx, y0 + dy
            weight = (1 - (points[..., 0] - x).abs()) * (1 - (points[..., 1] - y).abs())
            inside = ((x >= 0) & (x <= w - 1) & (y >= 0) & (y <= h - 1)).to(features.dtype)
            index = base + y.clamp(0, h - 1).long() * w + x.clamp(0, w - 1).long()
            taken = rows[index.reshape(-1)].reshape(index.shape[0], index.shape[1], c) * (weight * inside)[..., None]
            out = taken if out is None else out + taken
    return out.permute(0, 2, 1)


def solve4(a: Tensor, rhs: Tensor) -> Tensor:
    """Symmetric positive definite `[B, 4, 4]` against `[B, 4, k]`, by an unrolled Cholesky (ONNX has no solver)."""
    low: list[list[Tensor]] = [[None] * 4 for _ in range(4)]  # type: ignore[list-item]
    for i in range(4):
        for j in range(i + 1):
            value = a[:, i, j]
            for k in range(j):
                value = value - low[i][k] * low[j][k]
            low[i][j] = torch.sqrt(value.clamp_min(1e-9)) if i == j else value / low[j][j]
    y: list[Tensor] = []
    for i in range(4):
        value = rhs[:, i]
        for k in range(i):
            value = value - low[i][k][:, None] * y[k]
        y.append(value / low[i][i][:, None])
    x: list[Tensor] = [None] * 4  # type: ignore[list-item]
    for i in range(3, -1, -1):
        value = y[i]
        for k in range(i + 1, 4):
            value = value - low[k][i][:, None] * x[k]
        x[i] = value / low[i][i][:, None]
    return torch.stack(x, 1)


def patch_correlation(frame: Tensor, warped: Tensor, r: int) -> Tensor:
    """Mean product of each patch with the map at every offset: `[B, C, n, n]`, `[B, C, n + 2r, n + 2r]` ->
    `[B, (2r+1)^2, 8, 8]`, offsets dy-major.

    As matrix products: for a row offset, patch columns against window columns; the wanted sums are its diagonals.
    """
    b, c, n, _ = frame.shape
    p, k = n // PATCHES, 2 * r + 1
    q = p + 2 * r
    rows = torch.stack([warped[:, :, y * p : y * p + q] for y in range(PATCHES)], 1)
    windows = torch.stack([rows[..., x * p : x * p + q] for x in range(PATCHES)], 2)  # [B, 8, 8, C, q, q]
    patches = frame.reshape(-1, c, PATCHES, p, PATCHES, p).permute(0, 2, 4, 5, 1, 3).reshape(-1, p, c * p)
    diagonals = torch.zeros(p, q, k)
    for x in range(p):
        for dx in range(k):
            diagonals[x, x + dx, dx] = 1.0 / (p * p)
    diagonals = diagonals.reshape(p * q, k).to(frame)
    sums = []
    for dy in range(k):
        window = windows[..., dy : dy + p, :].reshape(-1, c * p, q)
        sums.append(torch.matmul(patches, window).reshape(-1, p * q) @ diagonals)
    return torch.stack(sums, 1).reshape(-1, PATCHES, PATCHES, k * k).permute(0, 3, 1, 2)


class Head(nn.Module):
    """Correlations of the patches `[B, K, 8, 8]` -> corrected logits `[B, K, 8, 8]` and log scale of the error `[B, 1, 8, 8]`."""

    def __init__(self, k: int, width: int = 64):
        super().__init__()
        self.first = nn.Conv2d(k, width, 3, 1, 1)
        self.second = nn.Conv2d(width, width, 3, 1, 1)
        self.logits = nn.Conv2d(width, k, 1)
        self.scale = nn.Conv2d(width, 1, 1)
        nn.init.zeros_(self.logits.weight)
        nn.init.zeros_(self.logits.bias)

    def forward(self, raw: Tensor) -> tuple[Tensor, Tensor]:
        x = torch.relu(self.first(raw))
        x = torch.relu(self.second(x))
        return raw + self.logits(x), self.scale(x)


@dataclass
class Step:
    """What one iteration did; corners `[B, 4, 2]` in crop pixels, shifts in frame pixels."""

    corners: Tensor
    before: Tensor
    logits: Tensor
    shift: Tensor
    log_scale: Tensor
    normal: Tensor
    residual: Tensor


class RefineNet(nn.Module):
    """Map crop `[1 or B, 3, R, R]` and frame `[B, 2, r, r]` at the same metres per pixel -> corners of the frame in the crop."""

    def __init__(self, map_px: int = 240, frame_px: int = 192, widths=(16, 32, 64, 96), channels: int = 32, levels=LEVELS):
        super().__init__()
        self.map_px, self.frame_px, self.levels = map_px, frame_px, tuple(levels)
        self.map_encoder = Encoder(3, widths, channels, "batch")
        self.frame_encoder = Encoder(2, widths, channels, "group")
        self.heads = nn.ModuleList([Head((2 * level.radius + 1) ** 2) for level in self.levels])
        self.log_factors = nn.Parameter(torch.full((len(self.levels),), 3.0))

    def encode_map(self, image: Tensor) -> Tensor:
        return normalise(self.map_encoder((image - 0.45) * 4.0))

    def first_corners(self) -> Tensor:
        """Inclusive corners of a frame that lies in the middle of the crop, unturned."""
        a = (self.map_px - self.frame_px) / 2
        b = a + self.frame_px - 1
        return torch.tensor([[[a, a], [b, a], [a, b], [b, b]]])

    def encode_standard(self, frame: Tensor) -> tuple[Tensor, Tensor]:
        """Frame -> unit features `[B, C, r/2, r/2]` and the share of each cell that was seen `[B, 1, r/2, r/2]`."""
        standard = standardise_frame(frame)
        return normalise(self.frame_encoder(standard)), nn.functional.avg_pool2d(standard[:, 1:], 2)

    def forward(self, map_features: Tensor, frame: Tensor) -> list[Step]:
        return self.iterate(map_features, *self.encode_standard(frame))

    def iterate(self, map_features: Tensor, fine: Tensor, seen: Tensor) -> list[Step]:
        """All levels, coarse to fine."""
        fine, seen, map_features = fine.float(), seen.float(), map_features.float()
        batch = fine.shape[0]
        maps = map_features.expand(batch, -1, -1, -1)
        corners = self.first_corners().to(fine).expand(batch, 4, 2)
        steps = []
        for index, level in enumerate(self.levels):
            steps.append(self.step(index, level, maps, fine, seen, corners))
            corners = steps[-1].corners.detach()
        return steps

    def step(self, index: int, level: Level, maps: Tensor, fine: Tensor, seen: Tensor, corners: Tensor) -> Step:
        """One iteration."""
        pool, r = level.pool, level.radius
        stride = 2 * pool  # crop pixels per pooled cell
        f, m, mask = fine, maps, seen
        if pool > 1:
            f = normalise(nn.functional.avg_pool2d(fine * seen, pool))
            m = normalise(nn.functional.avg_pool2d(maps, pool))
            mask = nn.functional.avg_pool2d(seen, pool)
        f = f * mask
        n = f.shape[-1]
        # Frame cells, with a rim of r cells, in frame pixels; then where they lie in the crop, in pooled map cells.
        cells = torch.arange(-r, n + r, dtype=torch.float32, device=f.device) * stride + (stride - 1) / 2
        grid_y, grid_x = torch.meshgrid(cells, cells, indexing="ij")
        homography = homography_of_square(corners, float(self.frame_px))
        at = apply(homography, torch.stack([grid_x.reshape(-1), grid_y.reshape(-1)], 1))
        warped = gather_bilinear(m, (at - (stride - 1) / 2) / stride)
        warped = warped.reshape(-1, m.shape[1], n + 2 * r, n + 2 * r)
        per_patch = n // PATCHES
        share = nn.functional.avg_pool2d(mask, per_patch)  # [B, 1, 8, 8]
        raw = patch_correlation(f, warped, r)
        raw = raw / (share + 0.05) * torch.exp(self.log_factors[index])
        logits, log_scale = self.heads[index](raw)
        offsets = torch.arange(-r, r + 1, dtype=torch.float32, device=f.device) * stride
        p = torch.softmax(logits, 1).reshape(-1, 2 * r + 1, 2 * r + 1, PATCHES * PATCHES)
        shift_x = (p.sum(1) * offsets[None, :, None]).sum(1)
        shift_y = (p.sum(2) * offsets[None, :, None]).sum(1)
        shift = torch.stack([shift_x, shift_y], 2)  # [B, 64, 2], frame pixels
        # Of a patch's error, in pooled cells; its weight is what a Gaussian of that scale would have.
        log_scale = torch.clamp(log_scale.reshape(-1, PATCHES * PATCHES), -4.0, 3.0)
        weight = torch.exp(-2.0 * log_scale) * share.reshape(-1, PATCHES * PATCHES)
        # Weighted least squares of four corner displacements (bilinear in between); a weak pull towards "no change".
        side = self.frame_px / PATCHES
        middles = torch.arange(PATCHES, dtype=torch.float32, device=f.device) * side + (side - 1) / 2
        my, mx = torch.meshgrid(middles, middles, indexing="ij")
        points = torch.stack([mx.reshape(-1), my.reshape(-1)], 1)
        basis = bilinear_basis(points, float(self.frame_px))
        normal = torch.einsum("bn,ni,nj->bij", weight, basis, basis) + 1e-3 * torch.eye(4, device=f.device)
        moved = solve4(normal, torch.einsum("bn,ni,bnk->bik", weight, basis, shift))
        left = shift - torch.einsum("ni,bik->bnk", basis, moved)
        residual = torch.sqrt((weight * (left * left).sum(2)).sum(1) / (weight.sum(1) + 1e-6) / 2)
        e = float(self.frame_px - 1)
        square = torch.tensor([[0.0, 0.0], [e, 0.0], [0.0, e], [e, e]], device=f.device)
        return Step(apply(homography, square[None] + moved), corners, logits, shift, log_scale, normal, residual)

    def displacement(self, corners: Tensor) -> Tensor:
        """Corners of frame pixels' centres -> the bundle's convention: the frame's edges in the crop, as inclusive
        corners, less the identity corners of the crop. `[B, 2, 2, 2]`."""
        a, b = -0.5, self.frame_px - 0.5
        edges = torch.tensor([[a, a], [b, a], [a, b], [b, b]], device=corners.device)
        at = apply(homography_of_square(corners, float(self.frame_px)), edges)
        e = float(self.map_px - 1)
        # left edge + 0.5, right edge - 0.5: published corners are inclusive pixels.
        inward = torch.tensor([[0.5, 0.5], [-0.5, 0.5], [0.5, -0.5], [-0.5, -0.5]], device=corners.device)
        identity = torch.tensor([[0.0, 0.0], [e, 0.0], [0.0, e], [e, e]], device=corners.device)
        return (at + inward - identity).permute(0, 2, 1).reshape(-1, 2, 2, 2)


class MapSide(nn.Module):
    """`map` -> `map_features`, for export."""

    def __init__(self, net: RefineNet):
        super().__init__()
        self.net = net

    def forward(self, map: Tensor) -> Tensor:  # noqa: A002 (the graph's input name)
        return self.net.encode_map(map)


class Matcher(nn.Module):
    """`map_features`, `frame` -> `displacement`, `residual` (crop pixels), `weight`, `covariance` (per axis, px^2) and
    `iterations` `[K, B, 2, 2, 2]`, the cumulative displacements level by level."""

    def __init__(self, net: RefineNet):
        super().__init__()
        self.net = net

    def forward(self, map_features: Tensor, frame: Tensor) -> tuple[Tensor, ...]:
        steps = self.net(map_features, frame)
        last = steps[-1]
        eye = torch.eye(4, device=frame.device).expand(frame.shape[0], 4, 4)
        inverse = solve4(last.normal, eye)
        covariance = inverse * (last.residual * last.residual)[:, None, None]
        weight = torch.diagonal(last.normal, dim1=1, dim2=2).sum(1)
        iterations = torch.stack([self.net.displacement(step.corners) for step in steps])
        return iterations[-1], last.residual, weight, covariance, iterations


def loss_of(net: RefineNet, steps: list[Step], truth: Tensor, gamma: float = 0.85) -> tuple[Tensor, Tensor]:
    """Patch cross-entropy at the true shift given the state before each step, plus L1 of the corners weighted by
    gamma as in Eq. (3) -> loss `[B]`, mean corner error of the last step `[B]` (crop pixels).

    `truth` `[B, 3, 3]`: frame pixels -> crop pixels."""
    side = net.frame_px / PATCHES
    middles = torch.arange(PATCHES, dtype=torch.float32) * side + (side - 1) / 2
    my, mx = torch.meshgrid(middles, middles, indexing="ij")
    points = torch.stack([mx.reshape(-1), my.reshape(-1)], 1)
    e = float(net.frame_px - 1)
    square = torch.tensor([[0.0, 0.0], [e, 0.0], [0.0, e], [e, e]])
    true_corners = apply(truth, square)
    total = torch.zeros(truth.shape[0])
    for index, (level, step) in enumerate(zip(net.levels, steps, strict=True)):
        # truth = H_before o U: the true shift of a patch in the frame is H_before^-1 truth(p) - p.
        before = torch.linalg.inv(homography_of_square(step.before.detach(), float(net.frame_px)))
        wanted = apply(before, apply(truth, points)) - points
        stride, r = 2 * level.pool, level.radius
        cell = wanted / stride + r
        inside = ((cell >= 0) & (cell <= 2 * r)).all(2).float()
        log_p = torch.log_softmax(step.logits, 1).reshape(-1, 2 * r + 1, 2 * r + 1, PATCHES * PATCHES)
        cell = cell.clamp(0, 2 * r)
        x0 = cell[..., 0].floor().clamp(max=2 * r - 1)
        y0 = cell[..., 1].floor().clamp(max=2 * r - 1)
        b = torch.arange(truth.shape[0])[:, None]
        p = torch.arange(PATCHES * PATCHES)[None]
        cross = torch.zeros_like(x0)
        for dx in (0, 1):
            for dy in (0, 1):
                w = (1 - (cell[..., 0] - x0 - dx).abs()) * (1 - (cell[..., 1] - y0 - dy).abs())
                cross = cross - w * log_p[b, (y0 + dy).long(), (x0 + dx).long(), p]
        # A patch's say in the fit is also its likelihood: a Laplace scale for its shift, so that weights mean something.
        miss = (step.shift - wanted).abs().sum(2) / stride
        laplace = miss.clamp(max=4.0) * torch.exp(-step.log_scale) + 2 * step.log_scale
        corner = (step.corners - true_corners).norm(dim=2).mean(1)
        share = gamma ** (len(steps) - 1 - index)
        total = total + share * ((cross + 0.2 * laplace) * inside).mean(1) + share * 0.1 * (corner / stride).clamp(max=8.0)
    return total, corner
