"""Model bundles: the one door through which every bundle is written, and how Python reads one.

Writing::

    from sthn.bundle import golden_arrays, in_memory, write_bundle

    graphs = {"coarse_map": onnx_bytes_or_path, "coarse": ..., "refine_map": ..., "refine": ...}  # refine_*: if there are two
    manifest = {...}   # as in src/model/manifest.rs, WITHOUT `golden` and the stages' `map_graph` and `graph`:
                       # file names and digests are filled in here
    golden = golden_arrays(
        inputs={"coarse_map": {"map": a}, "coarse": {"map_features": b, "frame": c}, ...},    # what the graphs are fed
        outputs={"coarse_map": {"map_features": d}, "coarse": {"displacement": e}, ...},      # what TORCH gave for that
    )
    golden |= {"map_rgb": ..., "frame": ..., "final": ..., "homography": ...}                 # see `write_bundle`
    differences = write_bundle(folder, manifest, graphs, golden)

`write_bundle` refuses to finish (raises [`BundleError`], leaves the folder as it was) unless the manifest is valid, the graphs
have the inputs and outputs of its stages' kinds, and **every graph, run by ONNX Runtime on the golden inputs, gives the golden
outputs** to the stage's tolerance: golden outputs come from torch, so that this is the check of the export.
`in_memory(manifest, graphs)` gives a [`Bundle`] to run before it is written, for the golden pair's `final` and `homography`.

Reading: `read_bundle(folder)` checks manifest and digests, `Bundle.run("coarse", map_features=..., frame=...)` runs a graph,
`Bundle.check()` compares with the golden pair again.
"""

from __future__ import annotations

import copy
import hashlib
import io
import shutil
import tempfile
import tomllib
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from . import geometry
from . import manifest as rules

MAX_GOLDEN_BYTES = 10 << 20
"""Size of `golden.npz`: the contract's 10 MiB."""

GRAPHS = ("coarse_map", "coarse", "refine_map", "refine")

Arrays = dict[str, NDArray[Any]]


class BundleError(ValueError):
    """A bundle that is not what it must be. The text names file or array, expected and found."""


def ports(manifest: Mapping[str, Any], graph: str) -> tuple[tuple[str, ...], str]:
    """Inputs and the main output of a graph, by its stage's kind."""
    if graph.endswith("_map"):
        return ("map",), "map_features"
    if manifest[graph]["kind"] == "correlation":
        return ("frame",), "frame_features"
    return ("map_features", "frame"), "displacement"


def graph_names(manifest: Mapping[str, Any]) -> tuple[str, ...]:
    """The graphs of a bundle: two per stage."""
    return GRAPHS if "refine" in manifest else GRAPHS[:2]


class Bundle:
    """A bundle's manifest, its graphs in ONNX Runtime sessions (CPU), and its golden pair where it has one yet."""

    def __init__(
        self, manifest: dict[str, Any], graphs: Mapping[str, bytes], golden: Arrays | None = None, threads: int = 1
    ) -> None:
        self.manifest = manifest
        self.golden = golden
        self.sessions: dict[str, onnxruntime.InferenceSession] = {}
        names = graph_names(manifest)
        if set(graphs) != set(names):
            raise BundleError(f"graphs: expected {', '.join(names)}, found {', '.join(graphs)}")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.log_severity_level = 3
        for name in names:
            try:
                session = onnxruntime.InferenceSession(graphs[name], options, providers=["CPUExecutionProvider"])
            except Exception as error:  # ONNX Runtime's own exception types are not public
                raise BundleError(f"{name}: {error}") from error
            self._check_ports(name, session)
            self.sessions[name] = session

    def _check_ports(self, name: str, session: onnxruntime.InferenceSession) -> None:
        inputs, output = ports(self.manifest, name)
        if {port.name for port in session.get_inputs()} != set(inputs):
            raise BundleError(f"{name}: inputs: expected {', '.join(inputs)}, found {[p.name for p in session.get_inputs()]}")
        if output not in {port.name for port in session.get_outputs()}:
            raise BundleError(f"{name}: outputs: expected {output}, found {[p.name for p in session.get_outputs()]}")
        for port in [*session.get_inputs(), *session.get_outputs()]:
            if port.type != "tensor(float)":
                raise BundleError(f"{name}: {port.name}: expected tensor(float), found {port.type}")
        stage = self.manifest[name.removesuffix("_map")]
        for port in session.get_inputs():
            if port.name == "map_features":
                continue
            spec = stage[port.name]
            wanted = [rules.CONTENT_CHANNELS[spec["content"]], spec["size_px"], spec["size_px"]]
            sizes = port.shape[1:]
            if len(port.shape) != 4 or any(isinstance(n, int) and n != m for n, m in zip(sizes, wanted, strict=True)):
                raise BundleError(f"{name}: {port.name}: expected [batch, {', '.join(map(str, wanted))}], found {port.shape}")

    def run(self, graph: str, **inputs: NDArray[Any]) -> dict[str, NDArray[np.float32]]:
        """Runs a graph; every output by name."""
        session = self.sessions[graph]
        fed = {name: np.ascontiguousarray(value, dtype=np.float32) for name, value in inputs.items()}
        names = [port.name for port in session.get_outputs()]
        try:
            return dict(zip(names, session.run(names, fed), strict=True))
        except Exception as error:  # ONNX Runtime's own exception types are not public
            raise BundleError(f"{graph}: {error}") from error

    def check(self, tolerance_px: float | None = None) -> dict[str, float]:
        """Largest difference of every golden output; raises [`BundleError`] above its tolerance.

        Displacements must agree to the stage's tolerance (and to `tolerance_px`); other outputs to the tolerance times their
        largest magnitude, where that is above 1. Where `map_features` is no golden input, the map encoder's golden output is
        fed.
        """
        if self.golden is None:
            raise BundleError("golden.npz: expected a golden pair, found none")
        found = {}
        for graph in graph_names(self.manifest):
            stage = self.manifest[graph.removesuffix("_map")]
            tolerance = stage["tolerance_px"] if stage["kind"] == "matcher" else stage["tolerance"]
            inputs, main = ports(self.manifest, graph)
            fed = {port: self._golden_input(graph, port) for port in inputs}
            outputs = self.run(graph, **fed)
            prefix = f"{graph}.out."
            if f"{prefix}{main}" not in self.golden:
                raise BundleError(f"golden.npz: {prefix}{main}: expected an array, found none")
            for key in [key for key in self.golden if key.startswith(prefix)]:
                port, expected = key.removeprefix(prefix), self.golden[key]
                if port not in outputs or outputs[port].shape != expected.shape:
                    shape = outputs[port].shape if port in outputs else "no such output"
                    raise BundleError(f"golden.npz: {key}: expected {shape}, found {expected.shape}")
                difference = float(np.abs(outputs[port].astype(np.float64) - expected).max())
                bound = tolerance * max(1.0, float(np.abs(expected).max()))
                if port in ("displacement", "iterations"):
                    bound = tolerance if tolerance_px is None else min(tolerance, tolerance_px)
                if not difference <= bound:  # NaN is refused too
                    raise BundleError(f"golden.npz: {key}: expected a difference of at most {bound:.3g}, found {difference:.3g}")
                found[key] = difference
        return found

    def _golden_input(self, graph: str, port: str) -> NDArray[Any]:
        assert self.golden is not None
        for key in (f"{graph}.in.{port}", f"{graph}_map.out.{port}"):
            if key in self.golden:
                return self.golden[key]
        raise BundleError(f"golden.npz: {graph}.in.{port}: expected an array, found none")


def golden_arrays(inputs: Mapping[str, Mapping[str, Any]], outputs: Mapping[str, Mapping[str, Any]]) -> Arrays:
    """`{graph: {port: array}}` of inputs and of torch's outputs -> the golden pair's `<graph>.in.*` and `<graph>.out.*`."""
    arrays = {}
    for kind, graphs in (("in", inputs), ("out", outputs)):
        for graph, named in graphs.items():
            arrays |= {f"{graph}.{kind}.{port}": np.asarray(value, dtype=np.float32) for port, value in named.items()}
    return arrays


def in_memory(manifest: dict[str, Any], graphs: Mapping[str, bytes | str | Path], golden: Arrays | None = None) -> Bundle:
    """A bundle that is not written yet. `manifest` as for [`write_bundle`]."""
    content = {name: _bytes(graph) for name, graph in graphs.items()}
    return Bundle(_complete(manifest, content, b""), content, golden)


def write_bundle(
    folder: str | Path,
    manifest: dict[str, Any],
    graphs: Mapping[str, bytes | str | Path],
    golden: Mapping[str, NDArray[Any]],
    tolerance_px: float | None = None,
) -> dict[str, float]:
    """Writes a bundle of either kind, checked; returns the largest difference of every golden output.

    `manifest`: see `src/model/manifest.rs`, without `golden` and the stages' `map_graph` and `graph`.
    `graphs`: `coarse_map`, `coarse` and, of a two-stage bundle, `refine_map`, `refine`: ONNX bytes or a path.
    `golden`: `map_rgb` u8 [W, W, 3], W = window_width_m + 2 window_margin_m; `frame` u8 [F, F], F = frame_width_m;
    `<graph>.in.<name>`, `<graph>.out.<name>` f32 (`coarse.in.map_features` and `refine.in.map_features` may be left out where
    they are the map encoder's output); `final` f64 [2, 2, 2] in inclusive corners of the coarse map input; `homography`
    f64 [3, 3] from rectified-frame px to window px (without margin), [2][2] = 1.
    `tolerance_px`: a bound for displacements here, where it is tighter than the manifest's, which holds on every machine.
    An existing bundle in `folder` is replaced, other folders are not touched.
    """
    folder = Path(folder)
    if folder.exists() and any(folder.iterdir()) and not (folder / "bundle.toml").is_file():
        raise BundleError(f"{folder}: expected a bundle, an empty folder or none, found other files")
    content = {name: _bytes(graph) for name, graph in graphs.items()}
    _check_golden(manifest, golden)
    packed = _pack(golden)
    complete = _complete(manifest, content, packed)
    # What is stored is what is checked: graphs and golden pair as they will be read.
    differences = Bundle(complete, content, _unpack(packed, "golden.npz")).check(tolerance_px)
    text = rules.to_toml(complete)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}-") as temporary:
        made = Path(temporary) / folder.name
        made.mkdir()
        for name, onnx in content.items():
            (made / f"{name}.onnx").write_bytes(onnx)
        (made / "golden.npz").write_bytes(packed)
        (made / "bundle.toml").write_text(text, encoding="utf-8")
        keep = [path for path in folder.iterdir() if path.name not in _own_files()] if folder.exists() else []
        for path in keep:  # a training curve, a readme: whatever stands beside the bundle stays
            shutil.move(path, made / path.name)
        if folder.exists():
            shutil.rmtree(folder)
        made.rename(folder)
    return differences


def read_bundle(folder: str | Path, threads: int = 1) -> Bundle:
    """Opens a bundle: manifest and digests are checked, every error names file and field."""
    folder = Path(folder)
    try:
        manifest = tomllib.loads((folder / "bundle.toml").read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise BundleError(f"{folder / 'bundle.toml'}: {error}") from error
    try:
        rules.check(manifest)
    except rules.ManifestError as error:
        raise BundleError(f"{folder / 'bundle.toml'}: {error}") from error
    graphs = {}
    for name in graph_names(manifest):
        stage = manifest[name.removesuffix("_map")]
        graphs[name] = _read_checked(folder, stage["map_graph" if name.endswith("_map") else "graph"])
    packed = _read_checked(folder, manifest["golden"])
    return Bundle(manifest, graphs, _unpack(packed, f"{folder / 'golden.npz'}"), threads)


def _own_files() -> set[str]:
    return {"bundle.toml", "golden.npz", *(f"{name}.onnx" for name in GRAPHS)}


def _bytes(graph: bytes | str | Path) -> bytes:
    return graph if isinstance(graph, bytes) else Path(graph).read_bytes()


def _reference(name: str, content: bytes) -> dict[str, str]:
    return {"file": name, "sha256": hashlib.sha256(content).hexdigest()}


def _complete(manifest: dict[str, Any], graphs: Mapping[str, bytes], golden: bytes) -> dict[str, Any]:
    """The manifest with file names and digests, checked."""
    complete = copy.deepcopy(manifest)
    complete["golden"] = _reference("golden.npz", golden)
    for name, onnx in graphs.items():
        if name not in GRAPHS:
            raise BundleError(f"graphs: expected {', '.join(GRAPHS)}, found {name}")
        stage = complete.get(name.removesuffix("_map"))
        if not isinstance(stage, dict):
            raise BundleError(f"{name}: expected a stage of that name in the manifest, found none")
        stage["map_graph" if name.endswith("_map") else "graph"] = _reference(f"{name}.onnx", onnx)
    try:
        rules.check(complete)
    except rules.ManifestError as error:
        raise BundleError(f"manifest: {error}") from error
    return rules.ordered(complete)


def _check_golden(manifest: Mapping[str, Any], golden: Mapping[str, NDArray[Any]]) -> None:
    """Names, shapes and types of the golden pair, and that the homography is that of its final corners."""
    side = int(manifest["window_width_m"] + 2 * manifest["window_margin_m"])
    frame = int(manifest["frame_width_m"])
    wanted = {
        "map_rgb": ((side, side, 3), np.uint8),
        "frame": ((frame, frame), np.uint8),
        "final": ((2, 2, 2), np.float64),
        "homography": ((3, 3), np.float64),
    }
    for name, (shape, kind) in wanted.items():
        if name not in golden:
            raise BundleError(f"golden.npz: {name}: expected an array, found none")
        if golden[name].shape != shape or golden[name].dtype != kind:
            found = f"{golden[name].dtype} {golden[name].shape}"
            raise BundleError(f"golden.npz: {name}: expected {np.dtype(kind)} {shape}, found {found}")
        if not np.isfinite(golden[name]).all():
            raise BundleError(f"golden.npz: {name}: expected finite numbers")
    for name, value in golden.items():
        if name in wanted:
            continue
        graph, _, rest = name.partition(".")
        if graph not in graph_names(manifest) or not rest.startswith(("in.", "out.")):
            raise BundleError(f"golden.npz: {name}: expected <graph>.in.<name> or <graph>.out.<name> of a graph of the bundle")
        if value.dtype != np.float32:
            raise BundleError(f"golden.npz: {name}: expected float32, found {value.dtype}")
    if golden["homography"][2, 2] != 1:
        raise BundleError(f"golden.npz: homography: expected [2][2] = 1, found {golden['homography'][2, 2]}")
    spec = manifest["coarse"]["map"]
    margin_px = 0.0 if manifest["coarse"]["kind"] == "matcher" else manifest["window_margin_m"]
    edges = geometry.edges_of_inclusive(
        geometry.displaced(spec["size_px"], golden["final"]), spec["width_m"] / spec["size_px"], margin_px
    )
    away = np.abs(geometry.apply(golden["homography"], geometry.edge_corners(frame)) - edges).max()
    if not away < 1e-6:
        raise BundleError(f"golden.npz: homography: expected the one of `final` to 1e-6 px, found {away:.3g} px at a corner")


def _pack(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """A deflated npz, the same bytes for the same arrays."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, value in arrays.items():
            one = io.BytesIO()
            np.lib.format.write_array(one, np.ascontiguousarray(value), allow_pickle=False)
            entry = zipfile.ZipInfo(f"{name}.npy")  # dated 1980: no clock in it
            entry.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(entry, one.getvalue(), compresslevel=9)
    packed = buffer.getvalue()
    if len(packed) > MAX_GOLDEN_BYTES:
        raise BundleError(f"golden.npz: expected at most {MAX_GOLDEN_BYTES} bytes, found {len(packed)}")
    return packed


def _unpack(packed: bytes, name: str) -> Arrays:
    try:
        with np.load(io.BytesIO(packed), allow_pickle=False) as archive:
            return {key: archive[key] for key in archive.files}
    except (ValueError, OSError, zipfile.BadZipFile) as error:
        raise BundleError(f"{name}: {error}") from error


def _read_checked(folder: Path, reference: Mapping[str, str]) -> bytes:
    path = folder / reference["file"]
    try:
        content = path.read_bytes()
    except OSError as error:
        raise BundleError(f"{path}: {error}") from error
    digest = hashlib.sha256(content).hexdigest()
    if digest != reference["sha256"]:
        raise BundleError(f"{path}: expected sha256 {reference['sha256']}, found {digest}")
    return content
