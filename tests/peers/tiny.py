"""A map, a bundle and a frame, small enough to be made anew by each test run.

The bundle's one stage "finds" the frame in the middle of the window, whatever it sees: what is tested with it is all
that lies round the network. usage: tiny.py FOLDER -> FOLDER/{map.tif, bundle/, frame.png, frame.json}
"""

import hashlib
import json
import sys
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import rasterio
from onnx import TensorProto, helper
from PIL import Image
from rasterio.transform import from_origin
from rasterio.warp import transform

WINDOW_M, FRAME_M, MAP_PX, FRAME_PX = 1024, 512, 64, 32
EAST_M, NORTH_M, EPSG, SIDE_PX = 326_000.0, 2_788_000.0, 32640, 2400


def write_map(path: Path, rng: np.random.Generator) -> tuple[float, float]:
    """2.4 km of smooth noise at 1 m/px, UTM 40N; returns latitude and longitude of its middle."""
    coarse = Image.fromarray(rng.integers(20, 236, (SIDE_PX // 24, SIDE_PX // 24, 3), dtype=np.uint8))
    pixels = np.asarray(coarse.resize((SIDE_PX, SIDE_PX), Image.Resampling.BICUBIC))
    profile = {
        "driver": "GTiff",
        "width": SIDE_PX,
        "height": SIDE_PX,
        "count": 3,
        "dtype": "uint8",
        "crs": f"EPSG:{EPSG}",
        "transform": from_origin(EAST_M, NORTH_M, 1.0, 1.0),
        "tiled": True,
        "blockxsize": 256,
        "blockysize": 256,
        "compress": "deflate",
        "photometric": "rgb",
    }
    with rasterio.open(path, "w", **profile) as file:
        file.write(pixels.transpose(2, 0, 1))
    half = SIDE_PX / 2
    (lon,), (lat,) = transform(f"EPSG:{EPSG}", "EPSG:4326", [EAST_M + half], [NORTH_M - half])
    return lat, lon


def graph(name: str, inputs: list, outputs: list, nodes: list, constants: list) -> onnx.ModelProto:
    model = helper.make_model(
        helper.make_graph(nodes, name, inputs, outputs, initializer=constants),
        opset_imports=[helper.make_opsetid("", 17)],
        ir_version=9,
    )
    onnx.checker.check_model(model, full_check=True)
    return model


def tensor(name: str, shape: list) -> onnx.ValueInfoProto:
    return helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)


def map_graph() -> onnx.ModelProto:
    """Map image -> its mean over 8 x 8 px."""
    node = helper.make_node("AveragePool", ["map"], ["map_features"], kernel_shape=[8, 8], strides=[8, 8])
    side = MAP_PX // 8
    return graph("map", [tensor("map", [1, 3, MAP_PX, MAP_PX])], [tensor("map_features", [1, 3, side, side])], [node], [])


def displacement() -> np.ndarray:
    """Identity corners -> the frame's square in the middle of the window, in inclusive pixels of the map input."""
    edge = (WINDOW_M - FRAME_M) / 2 / (WINDOW_M / MAP_PX)
    d = np.zeros((1, 2, 2, 2), np.float32)
    d[0, 0, :, 0], d[0, 0, :, 1] = edge, -edge
    d[0, 1, 0, :], d[0, 1, 1, :] = edge, -edge
    return d


def match_graph() -> onnx.ModelProto:
    """Always the middle; both inputs are used, times nothing."""
    side = MAP_PX // 8
    constants = [
        helper.make_tensor("middle", TensorProto.FLOAT, [1, 2, 2, 2], displacement().ravel()),
        helper.make_tensor("nothing", TensorProto.FLOAT, [], [0.0]),
    ]
    nodes = [
        helper.make_node("ReduceMean", ["map_features"], ["map_mean"], keepdims=0),
        helper.make_node("ReduceMean", ["frame"], ["frame_mean"], keepdims=0),
        helper.make_node("Add", ["map_mean", "frame_mean"], ["both"]),
        helper.make_node("Mul", ["both", "nothing"], ["zero"]),
        helper.make_node("Add", ["middle", "zero"], ["displacement"]),
    ]
    inputs = [tensor("map_features", [1, 3, side, side]), tensor("frame", [1, 1, FRAME_PX, FRAME_PX])]
    return graph("match", inputs, [tensor("displacement", [1, 2, 2, 2])], nodes, constants)


def write_bundle(folder: Path) -> None:
    folder.mkdir()
    graphs = {"coarse_map": map_graph(), "coarse": match_graph()}
    for name, model in graphs.items():
        onnx.save(model, folder / f"{name}.onnx")

    def run(name: str, **inputs: np.ndarray) -> np.ndarray:
        session = onnxruntime.InferenceSession(graphs[name].SerializeToString(), providers=["CPUExecutionProvider"])
        return session.run(None, inputs)[0]

    map_in = np.full((1, 3, MAP_PX, MAP_PX), 128 / 255, np.float32)
    frame_in = np.full((1, 1, FRAME_PX, FRAME_PX), 128 / 255, np.float32)
    features = run("coarse_map", map=map_in)
    found = run("coarse", map_features=features, frame=frame_in)
    offset = (WINDOW_M - FRAME_M) / 2
    np.savez_compressed(
        folder / "golden.npz",
        **{
            "map_rgb": np.full((WINDOW_M, WINDOW_M, 3), 128, np.uint8),
            "frame": np.full((FRAME_M, FRAME_M), 128, np.uint8),
            "coarse_map.in.map": map_in,
            "coarse_map.out.map_features": features,
            "coarse.in.map_features": features,
            "coarse.in.frame": frame_in,
            "coarse.out.displacement": found,
            "final": found[0].astype(np.float64),
            "homography": np.array([[1, 0, offset], [0, 1, offset], [0, 0, 1]], np.float64),
        },
    )

    def file(name: str) -> str:
        digest = hashlib.sha256((folder / name).read_bytes()).hexdigest()
        return f'{{ file = "{name}", sha256 = "{digest}" }}'

    (folder / "bundle.toml").write_text(f"""\
schema = 1
name = "tiny"
licence = "MIT"
window_width_m = {WINDOW_M}.0
window_margin_m = 0.0
frame_width_m = {FRAME_M}.0
m_per_px = 1.0
search_radius_m = 400.0
tone_mapping = 1
opset = 17
golden = {file("golden.npz")}

[provenance]
description = "Two graphs that always answer: the middle. For tests."
command = "tests/peers/tiny.py"
data = []

[coarse]
kind = "matcher"
map_graph = {file("coarse_map.onnx")}
graph = {file("coarse.onnx")}
map = {{ size_px = {MAP_PX}, width_m = {WINDOW_M}.0, content = "rgb", resize = "half_pixel_antialias" }}
frame = {{ size_px = {FRAME_PX}, width_m = {FRAME_M}.0, content = "gray", resize = "half_pixel_antialias" }}
lookup = "published"
tolerance_px = 0.001
match_sigma_m = 5.0
""")


def main() -> None:
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(1)
    lat, lon = write_map(folder / "map.tif", rng)
    write_bundle(folder / "bundle")
    small = Image.fromarray(rng.integers(0, 256, (32, 40), dtype=np.uint8))
    small.resize((640, 512), Image.Resampling.BICUBIC).save(folder / "frame.png")
    (folder / "frame.json").write_text(json.dumps({"lat_deg": lat, "lon_deg": lon, "width": 640, "height": 512}))


if __name__ == "__main__":
    main()
