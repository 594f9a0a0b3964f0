"""Descriptors, retrieval over tiles, R2D2, LoFTR: the code paths with small or random weights."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.nn import functional as F

from sthn import geometry, rivals
from sthn.data.pair import Pair
from sthn.rivals import aggregation, loftr, r2d2, retrieval
from sthn.rivals.base import translation
from sthn.rivals.dinov2 import DinoV2


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)


def pair_at(x: int, y: int, window_px: int = 192, frame_px: int = 64) -> Pair:
    """The frame is the window's content at (x, y): a descriptor that sees at all finds it."""
    rng = np.random.default_rng(6)
    blocks = np.kron(rng.integers(0, 255, (window_px // 8, window_px // 8, 1)), np.ones((8, 8, 3))).astype(np.uint8)
    return Pair("tile", blocks, blocks[y : y + frame_px, x : x + frame_px, 0].copy(), translation(x, y))


def parameters(net: torch.nn.Module) -> int:
    return sum(p.numel() for p in net.parameters())


def test_published_sizes() -> None:
    with torch.device("meta"):
        assert parameters(retrieval.resnet50_conv4()) == 8_543_296  # torchvision's ResNet-50 without layer4 and fc
        assert parameters(DinoV2(384, 12, 1536, False)) == 22_056_576  # ViT-S/14
        assert parameters(DinoV2(1536, 40, 4096, True)) == 1_136_480_768  # ViT-g/14
        net = r2d2.R2d2()
    assert round(sum(v.numel() for v in net.state_dict().values()) / 1000) == 486
    keys = set(net.state_dict())
    assert {"ops.0.weight", "ops.18.weight", "ops.20.weight", "ops.22.weight", "clf.bias", "sal.weight"} <= keys
    assert "ops.1.weight" not in keys and "ops.1.running_var" in keys  # norms without weights


def test_lattice_of_the_paper() -> None:
    origins = retrieval.tile_origins(1536, 512)
    assert len(origins) == 841
    assert {tuple(o) for o in origins} >= {(512, 512), (512 - 14 * 35, 512 - 14 * 35), (512 + 14 * 35, 512)}
    assert set(np.diff(np.unique(origins[:, 0]))) == {35}
    assert retrieval.latency_s(5.84, 0.5, 841) == pytest.approx(5.84 * 842 + 0.5)


def test_gem_by_hand() -> None:
    x = torch.rand(2, 3, 4, 5)
    assert torch.allclose(aggregation.GeM()(x), (x**3).mean((2, 3)) ** (1 / 3), atol=1e-6)


def test_netvlad_by_hand() -> None:
    torch.manual_seed(0)
    net, x = aggregation.NetVlad(3, 5), torch.rand(1, 5, 2, 4)
    cells = F.normalize(x, dim=1)[0].flatten(1).T
    share = torch.softmax(cells @ net.conv.weight[:, :, 0, 0].T, 1)
    wanted = torch.zeros(3, 5)
    for cell, weights in zip(cells, share, strict=True):
        for k in range(3):
            wanted[k] += weights[k] * (cell - net.centroids[k])
    wanted = F.normalize(F.normalize(wanted, dim=1).flatten(), dim=0)
    assert torch.allclose(net(x)[0], wanted, atol=1e-6)


def test_vlad_by_hand_and_an_empty_centre() -> None:
    centres = torch.tensor([[1.0, 0.0], [0.0, 1.0], [-1.0, -1.0]])
    features = torch.tensor([[[2.0, 0.2], [0.1, 3.0], [0.3, 1.0]]])
    unit = F.normalize(features[0], dim=1)
    wanted = torch.stack([unit[0] - centres[0], (unit[1:] - centres[1]).sum(0), torch.zeros(2)])
    wanted = F.normalize(F.normalize(wanted, dim=1).flatten(), dim=0)
    assert torch.allclose(aggregation.vlad(features, centres)[0], wanted, atol=1e-6)


def test_dinov2_values_are_the_third_of_qkv() -> None:
    torch.manual_seed(0)
    net = DinoV2(64, 2, 128, True, places=9).eval()
    torch.nn.init.normal_(net.pos_embed)
    image = torch.rand(1, 3, 42, 42)
    seen = []
    net.blocks[1].attn.qkv.register_forward_hook(lambda _m, _i, out: seen.append(out))
    values = net.values(image, 1)
    assert values.shape == (1, 9, 64) and torch.equal(values, seen[0][:, 1:, 128:])
    assert net.values(torch.rand(1, 3, 56, 28), 1).shape == (1, 8, 64)  # places interpolated
    like = DinoV2.like(net.state_dict())
    like.load_state_dict(net.state_dict(), strict=True)
    assert torch.equal(like.values(image, 1), values)


def save_stgl(kind: str, path: Path, out: int | None) -> None:
    torch.manual_seed(1)
    net = retrieval.Stgl(kind, 4, out, width=8, blocks=(1, 1, 1))
    torch.save({"model_state_dict": {f"module.{key}": value for key, value in net.state_dict().items()}}, path)


@pytest.mark.parametrize("kind, out", [("netvlad", 32), ("netvlad", None), ("gem", 32), ("gem", None)])
def test_stgl_from_weights_on_disk_finds_the_tile(kind: str, out: int | None, tmp_path: Path) -> None:
    save_stgl(kind, tmp_path / "best_model.pth", out)
    (rival,) = rivals.available([f"stgl-{kind}"], **{f"stgl_{kind}": tmp_path / "best_model.pth"})
    assert rival.ready and rival.window_m == 1536
    rival.window_m, rival.stride_px, rival.thermal_contrast, rival.batch = 192, 32, 1.0, 5
    match = rival.match(pair_at(32, 64))
    assert match.detail["tiles"] == 16
    np.testing.assert_array_equal(match.homography, translation(32, 64))
    assert match.seconds == pytest.approx(17 * match.detail["t_e_s"] + match.detail["t_m_s"])
    with pytest.raises(rivals.RivalError, match="expected a window of 192 m, found 128 m"):
        rival.match(pair_at(0, 0, window_px=128))


def test_stgl_weights_are_read_strictly(tmp_path: Path) -> None:
    path = tmp_path / "best_model.pth"
    save_stgl("gem", path, 32)
    with pytest.raises(rivals.RivalError, match="aggregation.0.centroids"):
        rivals.available(["stgl-netvlad"], stgl_netvlad=path)
    torch.save({"weights": 1}, path)
    with pytest.raises(rivals.RivalError, match="expected a table of tensors"):
        rivals.available(["stgl-gem"], stgl_gem=path)


def test_anyloc_from_files_finds_the_tile(tmp_path: Path) -> None:
    torch.manual_seed(2)
    net = DinoV2(64, 2, 96, False, places=16)
    torch.save(net.state_dict(), tmp_path / "dinov2.pth")
    torch.save(F.normalize(torch.randn(4, 64), dim=1), tmp_path / "c_centers.pt")
    (rival,) = rivals.available(["anyloc"], anyloc=tmp_path)
    assert rival.note == "a smaller DINOv2, layer 1 of 2"
    rival.window_m, rival.stride_px = 192, 32
    np.testing.assert_array_equal(rival.match(pair_at(96, 32)).homography, translation(96, 32))
    torch.save(torch.randn(4, 32), tmp_path / "c_centers.pt")
    with pytest.raises(rivals.RivalError, match=r"expected centres \[K, 64\], found torch.Size\(\[4, 32\]\)"):
        rivals.available(["anyloc"], anyloc=tmp_path)


@pytest.mark.parametrize("name", ["r2d2", "anyloc", "stgl-netvlad", "stgl-gem"])
def test_no_weights_no_number(name: str) -> None:
    (rival,) = rivals.available([name])
    assert not rival.ready and rival.note == rivals.NO_WEIGHTS
    with pytest.raises(rivals.RivalError, match="no weights here"):
        rival.match(pair_at(0, 0))


def test_r2d2_keeps_the_size_and_the_place() -> None:
    torch.manual_seed(0)
    net = r2d2.R2d2(1, 16).eval()
    image = torch.rand(1, 3, 64, 64)
    descriptors, reliability, repeatability = net(image)
    assert descriptors.shape == (1, 16, 64, 64) and reliability.shape == repeatability.shape == (1, 1, 64, 64)
    assert torch.allclose(descriptors.norm(dim=1), torch.ones(1, 64, 64), atol=1e-5)
    points, values = r2d2.keypoints(net, image[0], threshold=0.0)
    assert len(points) > 20 and values.shape == (len(points), 16)
    x, y = points[0].astype(int)
    around = repeatability_of(net, image)[max(0, y - 1) : y + 2, max(0, x - 1) : x + 2]
    assert around.max() == repeatability_of(net, image)[y, x]
    none, _ = r2d2.keypoints(net, image[0], threshold=1.0)
    assert none.shape == (0, 2)
    np.testing.assert_allclose(r2d2.to_window(np.array([[-0.5, 255.5]]), 512), [[-0.5, 511.5]])


def repeatability_of(net: r2d2.R2d2, image: torch.Tensor) -> torch.Tensor:
    with torch.no_grad():
        return net(r2d2.normalise(image))[2][0, 0]


def test_r2d2_from_weights_on_disk_finds_the_frame(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Untrained descriptors match an image's own content; at a smaller input for speed.
    monkeypatch.setattr(r2d2, "SIDE_PX", 96)
    monkeypatch.setattr(r2d2.to_window, "__defaults__", (96,))
    torch.manual_seed(3)
    net = r2d2.R2d2()
    torch.save(
        {"net": "Quad_L2Net_ConfCFS()", "state_dict": {f"module.{k}": v for k, v in net.state_dict().items()}}, tmp_path / "r"
    )
    (rival,) = rivals.available(["r2d2"], r2d2=tmp_path / "r")
    rival.threshold = 0.0
    rng = np.random.default_rng(1)
    window = np.kron(rng.integers(0, 255, (24, 24, 1)), np.ones((8, 8, 3))).astype(np.uint8)
    pair = Pair("same", window, window[..., 0].copy(), np.eye(3))
    match = rival.match(pair)
    assert match.detail["inliers"] > 30
    corners = geometry.edge_corners(192)
    assert np.abs(geometry.apply(match.homography, corners) - corners).max() < 0.1
    rival.threshold = 1.0
    assert rival.match(pair).failed
    torch.save({"state_dict": {"ops.0.weight": torch.zeros(1)}}, tmp_path / "r")
    with pytest.raises(rivals.RivalError, match="ops.0.bias"):
        rivals.available(["r2d2"], r2d2=tmp_path / "r")


def test_loftr_says_what_it_lacks() -> None:
    (rival,) = rivals.available(["loftr"])
    expected = rivals.NO_WEIGHTS if loftr.installed() else "kornia is not installed here"
    assert not rival.ready and rival.note == expected


@pytest.mark.skipif(importlib.util.find_spec("kornia") is None, reason="kornia is not installed: LoFTR's forward pass is not run")
def test_loftr_with_random_weights(tmp_path: Path) -> None:
    torch.manual_seed(0)
    net = loftr.network()
    torch.save({"state_dict": {f"matcher.{key}": value for key, value in net.state_dict().items()}}, tmp_path / "loftr.ckpt")
    (rival,) = rivals.available(["loftr"], loftr=tmp_path / "loftr.ckpt")
    rival.side_px = 64
    match = rival.match(pair_at(0, 0, 128, 128))
    assert match.seconds > 0 and match.detail["matches"] >= 0
    rival.net.coarse_matching.thr = 0.0  # untrained: no match is confident, all mutual neighbours are let through
    assert rival.match(pair_at(0, 0, 128, 128)).detail["matches"] > 10
