"""The thermal generative module: published shapes and layout, training that goes on bit for bit, the extended set."""

import json
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
import rasterio
import torch

from sthn.data import Pair, open_source
from sthn.lite.scene import SceneMap, pyramid
from sthn.tgm import __main__ as command
from sthn.tgm import checkpoint, generate
from sthn.tgm.checkpoint import TgmError
from sthn.tgm.networks import Discriminator, Generator
from sthn.tgm.pairs import AlignedPairs, aligned, to_pixels, to_unit, usable_indices
from sthn.tgm.rendered import Night, RenderedPairs
from sthn.tgm.train import Recipe, batches, rate_of, train

SMALL = Recipe(size_px=32, downs=5, ngf=4, ndf=4, epochs=3, decay_epochs=1, steps_per_epoch=2, batch=2, seed=5)


@pytest.fixture(scope="module")
def scene() -> SceneMap:
    """A map of coloured fields."""
    rng = np.random.default_rng(2)
    rgb = np.kron(rng.integers(20, 250, (24, 24, 3)), np.ones((50, 50, 1))).astype(np.uint8)
    return SceneMap("fields", 1.0, pyramid(rgb), [], None, rgb.any(axis=2))


@pytest.fixture(scope="module")
def pairs(scene: SceneMap) -> AlignedPairs:
    source = RenderedPairs([scene], Night([scene], 3), 12, seed=1, size_px=32)
    return AlignedPairs(source, usable_indices(source), 32)


def parameters(net: torch.nn.Module) -> int:
    return sum(p.numel() for p in net.parameters())


def test_full_size_has_the_published_parameters() -> None:
    with torch.device("meta"):
        assert parameters(Generator()) == 74_022_657  # 74.0 M
        assert parameters(Discriminator()) == 2_766_657  # 2.77 M


def test_layout_is_the_published_one() -> None:
    with torch.device("meta"):
        keys = list(Generator().state_dict())
    assert keys[:2] == ["model.model.0.weight", "model.model.1.model.1.weight"]
    assert "model.model.3.1.bias" in keys and "model.model.1.model.5.1.weight" in keys
    innermost = "model." + "model.1." + "model.3." * 6
    assert innermost + "model.1.weight" in keys and innermost + "model.3.1.weight" in keys
    assert innermost + "model.4.running_mean" in keys


def test_judged_patches_are_70_px() -> None:
    net = Discriminator(2).eval()
    image = torch.zeros(1, 4, 256, 256, requires_grad=True)
    out = net(image[:, :3], image[:, 3:])
    assert out.shape == (1, 1, 30, 30)
    out[0, 0, 15, 15].backward()
    seen = image.grad.abs().sum((0, 1)) > 0
    assert seen.any(0).sum() <= 70 and seen.any(1).sum() <= 70 and seen.any(0).sum() >= 60


def test_rate_falls_over_the_second_half() -> None:
    recipe = Recipe()
    rates = [rate_of(recipe, epoch) for epoch in range(40)]
    assert rates[:20] == [2e-4] * 20 and 0 < rates[39] < 1.1e-5
    assert np.allclose(np.diff(rates[19:]), -2e-4 / 21)


def test_pairs_are_cut_through_the_truth() -> None:
    rng = np.random.default_rng(0)
    window = rng.integers(1, 255, (100, 100, 3), np.uint8)
    move = np.array([[1.0, 0, 30], [0, 1.0, 40], [0, 0, 1.0]])
    pair = Pair("moved", window, window[40:72, 30:62, 0], move)
    satellite, thermal = aligned(pair, 32)
    np.testing.assert_array_equal(satellite[..., 0], thermal)
    np.testing.assert_array_equal(to_pixels(to_unit(satellite)), np.moveaxis(satellite, -1, 0))


def test_black_frames_are_removed() -> None:
    class Source:
        name, window_m, search_radius_m = "black", 20, 0.0

        def __len__(self) -> int:
            return 2

        def __getitem__(self, index: int) -> Pair:
            thermal = np.full((20, 20), 9, np.uint8)
            thermal.reshape(-1)[: 50 + index] = 0
            return Pair(str(index), np.ones((20, 20, 3), np.uint8), thermal, np.eye(3))

    assert usable_indices(Source()) == [0]


def test_a_rendered_pair_is_its_number(scene: SceneMap) -> None:
    night = Night([scene], 3)
    one, two = (RenderedPairs([scene], night, 5, seed=1, size_px=64)[4] for _ in range(2))
    np.testing.assert_array_equal(one.thermal, two.thermal)
    np.testing.assert_array_equal(one.satellite, two.satellite)
    other = RenderedPairs([scene], Night([scene], 4), 5, seed=1, size_px=64)[4]
    np.testing.assert_array_equal(one.satellite, other.satellite)
    assert np.abs(one.thermal.astype(int) - other.thermal).mean() > 5


def test_training_goes_on_bit_for_bit(pairs: AlignedPairs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    train(SMALL, pairs, pairs, tmp_path / "whole")
    stopped = 0

    def stop_in_last_epoch(recipe: Recipe, count: int, epoch: int) -> list[list[int]]:
        nonlocal stopped
        if epoch == 2:
            stopped += 1
            raise KeyboardInterrupt
        return batches(recipe, count, epoch)

    with monkeypatch.context() as patch:
        patch.setattr("sthn.tgm.train.batches", stop_in_last_epoch)
        with pytest.raises(KeyboardInterrupt):
            train(SMALL, pairs, pairs, tmp_path / "parts")
    assert stopped == 1
    train(SMALL, pairs, pairs, tmp_path / "parts")
    whole, parts = (checkpoint.read(tmp_path / name / "last_model.pth") for name in ("whole", "parts"))
    assert whole["epoch_num"] == parts["epoch_num"] == 2
    for field in (checkpoint.GENERATOR, checkpoint.DISCRIMINATOR):
        for key, value in whole[field].items():
            assert key.startswith("module.") and torch.equal(value, parts[field][key])
    curves = [np.loadtxt(tmp_path / n / "curve.csv", delimiter=",", skiprows=1) for n in ("whole", "parts")]
    np.testing.assert_array_equal(np.delete(curves[0], 2, 1), np.delete(curves[1], 2, 1))  # all but seconds
    assert (tmp_path / "whole" / "samples-003.jpg").stat().st_size > 1000
    with pytest.raises(TgmError, match="recipe.ngf: expected 8, found 4"):
        train(Recipe(**{**whole["training"]["recipe"], "ngf": 8}), pairs, pairs, tmp_path / "parts")


def test_training_learns_the_rule(pairs: AlignedPairs, tmp_path: Path) -> None:
    recipe = Recipe(size_px=32, downs=5, ngf=8, ndf=4, epochs=1, decay_epochs=0, steps_per_epoch=70, batch=4, rate=2e-3)
    trainer = train(recipe, pairs, pairs, tmp_path)
    mean = torch.stack([pairs[i][1].mean() for i in range(len(pairs))]).mean()
    flat = torch.stack([(pairs[i][1] - mean).abs().mean() for i in range(len(pairs))]).mean().item()
    # Norms in training mode: their running statistics lag behind so short a run.
    trainer.generator.train()
    with torch.no_grad():
        satellite, thermal = (torch.stack(images) for images in zip(*(pairs[i] for i in range(len(pairs))), strict=True))
        l1 = (trainer.generator(satellite) - thermal).abs().mean().item()
    assert l1 < 0.75 * flat, (l1, flat)


def test_published_checkpoint_is_read_strictly(tmp_path: Path) -> None:
    net = Generator(5, 4).eval()
    path = tmp_path / "published.pth"
    # As the public code leaves it: DataParallel's prefix, numpy numbers beside the weights.
    torch.save({"epoch_num": 39, checkpoint.GENERATOR: checkpoint.published(net), "best_psnr": np.float64(21.5)}, path)
    loaded = checkpoint.load_generator(path)
    assert (loaded.downs, loaded.ngf) == (5, 4)
    image = torch.rand(1, 3, 32, 32) * 2 - 1
    with torch.no_grad():
        assert torch.equal(loaded(image), net(image))
    torch.save({checkpoint.GENERATOR: net.state_dict()}, path)
    assert checkpoint.load_generator(path).ngf == 4
    for change, text in [
        (lambda s: s.pop("module.model.model.3.1.bias"), "missing model.model.3.1.bias"),
        (lambda s: s.update({"module.more": torch.zeros(1)}), "unexpected more"),
        (lambda s: s.update({"module.model.model.3.1.bias": torch.zeros(2)}), r"model.model.3.1.bias: expected shape \(1,\)"),
    ]:
        state = checkpoint.published(net)
        change(state)
        torch.save({checkpoint.GENERATOR: state}, path)
        with pytest.raises(TgmError, match=text):
            checkpoint.load_generator(path)
    torch.save({"netG": {}}, path)
    with pytest.raises(TgmError, match="expected a table with model_netG_state_dict, found netG"):
        checkpoint.load_generator(path)


def test_extended_set_in_the_published_layout(scene: SceneMap, tmp_path: Path) -> None:
    net, rgb = Generator(5, 4).eval(), scene.levels[0][:300, :400].copy()
    rgb[:, 330:] = 0
    excluded = [generate.Region(0, 0, 120, 120)]
    places = generate.write_extended(net, rgb, tmp_path / "extended.h5", 128, 32, excluded=excluded)
    with h5py.File(tmp_path / "extended.h5") as file:
        images, names = file["image_data"], [name.decode() for name in file["image_name"][:]]
        assert images.shape == (len(places), 128, 128, 3) and images.dtype == np.uint8 and images.chunks == (1, 128, 128, 3)
        assert file["image_size"][0].tolist() == [128, 128]
        assert places == [tuple(map(int, name.split("@")[1:])) for name in names]
        tile = rgb[places[3][0] - 64 : places[3][0] + 64, places[3][1] - 64 : places[3][1] + 64]
        painted = cv2.resize(generate.paint(net, tile[None], 32)[0], (128, 128), interpolation=cv2.INTER_LINEAR)
        np.testing.assert_array_equal(images[3, ..., 0], painted)
    assert {r % 35 for r, _ in places} == {64 % 35} and all(c + 64 <= 332 for _, c in places)
    assert not any(r <= 120 and c <= 120 for r, c in places) and len(places) == len(set(places))
    with pytest.raises(TgmError, match="no tile of 128 px"):
        generate.write_extended(net, np.zeros_like(rgb), tmp_path / "none.h5", 128, 32)


def test_the_published_test_region_is_left_out() -> None:
    (region,) = generate.excluded("published")
    assert region.holds(270, 1400) and region.holds(2710, 9400) and not region.holds(2711, 5000) and not region.holds(500, 1399)
    assert generate.excluded("none") == [] and generate.excluded("1,2,3,4") == [generate.Region(1, 3, 2, 4)]
    for wrong in ("1,2,3", "2,1,3,4", "test"):
        with pytest.raises(TgmError, match=f"exclude: expected published.*found {wrong}"):
            generate.excluded(wrong)


def test_thermal_of_a_whole_map(scene: SceneMap, tmp_path: Path) -> None:
    net, rgb = Generator(5, 4).eval(), scene.levels[0][:210, :170].copy()
    rgb[:20] = 0
    gray = generate.thermal_of_map(net, rgb, 64, 32)
    assert gray.shape == (210, 170) and (gray[:20] == 0).all() and (gray[20:] > 0).all()
    like = tmp_path / "map.tif"
    profile = {"crs": "EPSG:32640", "transform": rasterio.transform.from_origin(3e5, 28e5, 1.0, 1.0)}
    with rasterio.open(like, "w", driver="GTiff", height=210, width=170, count=3, dtype="uint8", **profile) as target:
        target.write(rgb.transpose(2, 0, 1))
    generate.write_thermal_map(gray, like, tmp_path / "thermal.tif")
    with rasterio.open(tmp_path / "thermal.tif") as source:
        np.testing.assert_array_equal(source.read(1), gray)
        assert source.transform == profile["transform"] and source.crs.to_epsg() == 32640


def test_the_commands_go_together(scene: SceneMap, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "map.tif"
    profile = {"crs": "EPSG:32640", "transform": rasterio.transform.from_origin(3e5, 28e5, 1.0, 1.0)}
    with rasterio.open(path, "w", driver="GTiff", height=1200, width=1200, count=3, dtype="uint8", **profile) as target:
        target.write(scene.levels[0].transpose(2, 0, 1))
    data = tmp_path / "data.toml"
    table = 'kind = "maps"\nmaps = ["map.tif"]\nwindow_m = 600\nsearch_radius_m = 20\ncount = 4\n'
    data.write_text(f"[[train]]\n{table}[held_out]\n{table}seed = 9\n")
    words = ["--max-black-px", "99999"]
    words += "--size-px 32 --downs 5 --ngf 4 --ndf 4 --batch 2 --epochs 1 --decay-epochs 0 --steps-per-epoch 1".split()
    out = tmp_path / "out"
    assert command.main(["train", "--data", str(data), *words, "--out", str(out)]) == 0
    assert set(json.loads(capsys.readouterr().out)) == {"tgm", "training_mean", "own_mean"}
    # The published map is a PNG at 1 m/px; what is generated over it is read as the data set's extended split.
    satellite = tmp_path / "map.png"
    cv2.imwrite(str(satellite), scene.levels[0][..., ::-1])
    generated = ["generate", "--checkpoint", str(out / "last_model.pth"), "--map", str(satellite)]
    files = ["--h5", str(tmp_path / "extended_queries_test_excluded.h5"), "--database", str(tmp_path / "extended_database.h5")]
    assert command.main([*generated, *files, "--stride-px", "300"]) == 2
    assert "--exclude: expected published, none or r0,r1,c0,c1" in capsys.readouterr().err
    assert command.main([*generated, *files, "--stride-px", "300", "--exclude", "none"]) == 0
    extended = {"kind": "boson", "folder": ".", "split": "extended", "map": "map.png", "window_m": 512, "search_radius_m": 0.1}
    source = open_source(extended, root=tmp_path, purpose="train")
    satellites, thermals = zip(*(aligned(source[i], 32) for i in range(len(source))), strict=True)
    assert len(source) == 9
    painted = generate.paint(checkpoint.load_generator(out / "last_model.pth"), np.stack(satellites), 32)
    # Twice resized: nearly what the network paints of the ground under the frame, and not of any other.
    error = np.abs(painted[:, None].astype(float) - np.stack(thermals)[None]).mean((2, 3))
    assert (error.argmin(1) == np.arange(9)).all()
    assert command.main(generated) == 2
    assert "expected one of --h5 and --thermal-map" in capsys.readouterr().err
    files = [
        "--h5",
        str(tmp_path / "g/extended_queries_test_excluded.h5"),
        "--database",
        str(tmp_path / "g/extended_database.h5"),
    ]
    assert command.main([*generated[:4], str(path), *files, "--stride-px", "300", "--exclude", "0,300,0,1200"]) == 0
    over_tif = open_source(extended | {"folder": "g", "map": "map.tif"}, root=tmp_path, purpose="train")
    assert len(over_tif) == 6 and np.array_equal(over_tif[0].satellite, source[3].satellite)
    coarse = tmp_path / "coarse.tif"
    profile["transform"] = rasterio.transform.from_origin(3e5, 28e5, 1.1, 1.1)
    with rasterio.open(coarse, "w", driver="GTiff", height=1200, width=1200, count=3, dtype="uint8", **profile) as target:
        target.write(scene.levels[0].transpose(2, 0, 1))
    assert command.main([*generated[:4], str(coarse), *files]) == 2
    assert "expected 1 m/px within 2 % for --h5, found 1.100" in capsys.readouterr().err
    maps = ["--maps", str(path), "--held-out", str(path), "--width-m", "600"]
    assert command.main(["train", *maps, *words, "--out", str(out)]) == 2
    assert "--width-m: expected 512 with --maps, found 600" in capsys.readouterr().err
    data.write_text(f"[held_out]\n{table}")
    assert command.main(["train", "--data", str(data), *words, "--out", str(out)]) == 2
    assert "train: expected at least one table" in capsys.readouterr().err
