//! A small bundle of the light kind, made by hand: the features are brightness itself, so that the frame of a place
//! correlates with the place; the refine stage says that the coarse one was right.

use super::onnx::{Attribute, Constant, Node, Size, model};
use nightfix::locate::pair::{Search, Steps, encode_map, match_pair};
use nightfix::locate::{FrameView, WindowView};
use nightfix::model::{Bundle, Dim, Graph, Manifest, Port, Provider, Runtime, Tensor};
use rand::{RngExt, SeedableRng};
use sha2::{Digest, Sha256};
use std::io::Write;
use std::path::Path;

pub const WINDOW_PX: usize = 384;
pub const MARGIN_PX: usize = 32;
pub const FRAME_PX: usize = 128;
pub const SQUARE_PX: usize = WINDOW_PX + 2 * MARGIN_PX;

/// ONNX Runtime stands beside the test executables: `make build` puts it there.
pub fn runtime() -> Runtime {
    Runtime::open(None, None, Provider::Cpu, 1).expect("`make build` puts ONNX Runtime beside the test executables")
}

pub const MANIFEST: &str = r#"
schema = 1
name = "fixture"
licence = "MIT"
window_width_m = 384
window_margin_m = 32
frame_width_m = 128
m_per_px = 1
search_radius_m = 128
tone_mapping = 1
opset = 17
golden = { file = "golden.npz", sha256 = "GOLDEN" }

[provenance]
description = "made by a test"
command = "cargo test"
data = []

[coarse]
kind = "correlation"
map_graph = { file = "coarse_map.onnx", sha256 = "COARSE_MAP" }
graph = { file = "coarse.onnx", sha256 = "COARSE" }
stride = 2
rotations_deg = [-10.0, -5.0, 0.0, 5.0, 10.0]
scales = [0.9, 1.0, 1.1]
subcell_radius = 2
tolerance = 1e-4
match_sigma_m = 3.0

[coarse.map]
size_px = 112
width_m = 448
content = "rgb"
resize = "half_pixel_antialias"

[coarse.frame]
size_px = 32
width_m = 128
content = "gray_mask"
resize = "half_pixel_antialias"

[refine]
kind = "matcher"
map_graph = { file = "refine_map.onnx", sha256 = "REFINE_MAP" }
graph = { file = "refine.onnx", sha256 = "REFINE" }
lookup = "frame_indexed"
tolerance_px = 1e-4
match_sigma_m = 2.0

[refine.map]
size_px = 80
width_m = 160
content = "rgb"
resize = "supersample"

[refine.frame]
size_px = 64
width_m = 128
content = "gray_mask"
resize = "half_pixel_antialias"

[refine.crop]
shape = "oriented"
padding_m = 16
"#;

/// How much a unit of summed brightness product says.
const GAIN: f32 = 0.6;

/// `coarse_map`, `coarse`, `refine_map`, `refine`.
pub fn graphs() -> [(&'static str, Vec<u8>); 4] {
    let fixed = |dims: [i64; 4]| dims.map(Size::Fixed).to_vec();
    let pool = || Node {
        op: "AveragePool",
        inputs: vec!["map"],
        outputs: vec!["map_features"],
        attributes: vec![("kernel_shape", Attribute::Ints(vec![2, 2])), ("strides", Attribute::Ints(vec![2, 2]))],
    };
    let open = vec![Size::Fixed(1), Size::Fixed(3), Size::Open("h"), Size::Open("w")];
    let features = vec![Size::Fixed(1), Size::Fixed(3), Size::Open("fh"), Size::Open("fw")];
    let coarse_map = model(&[pool()], &[], &[("map", open)], &[("map_features", features)]);

    // Mean of 2 x 2, in each of three channels, of gray and of the mask; zero mean where seen, 0 elsewhere; times the gain.
    let over = || ("axes", Attribute::Ints(vec![1, 2, 3]));
    let node =
        |op, inputs: &[&'static str], output| Node { op, inputs: inputs.to_vec(), outputs: vec![output], attributes: vec![] };
    let halved = |weights, output| Node {
        op: "Conv",
        inputs: vec!["frame", weights],
        outputs: vec![output],
        attributes: vec![("strides", Attribute::Ints(vec![2, 2]))],
    };
    let mean = |of, output| Node { op: "ReduceMean", inputs: vec![of], outputs: vec![output], attributes: vec![over()] };
    let weights = |gray: f32, mask: f32| [[gray; 4], [mask; 4]].concat().repeat(3);
    let coarse = model(
        &[
            halved("of_gray", "gray"),
            halved("of_mask", "mask"),
            mean("gray", "gray_mean"),
            mean("mask", "mask_mean"),
            node("Div", &["gray_mean", "mask_mean"], "level"),
            node("Mul", &["level", "mask"], "base"),
            node("Sub", &["gray", "base"], "centred"),
            node("Div", &["centred", "mask_mean"], "fair"),
            node("Mul", &["fair", "gain"], "frame_features"),
        ],
        &[
            Constant { name: "of_gray", dims: vec![3, 2, 2, 2], values: weights(0.25, 0.0) },
            Constant { name: "of_mask", dims: vec![3, 2, 2, 2], values: weights(0.0, 0.25) },
            Constant { name: "gain", dims: vec![1], values: vec![GAIN] },
        ],
        &[("frame", vec![Size::Open("b"), Size::Fixed(2), Size::Fixed(32), Size::Fixed(32)])],
        &[("frame_features", vec![Size::Open("b"), Size::Fixed(3), Size::Fixed(16), Size::Fixed(16)])],
    );

    let refine_map = model(&[pool()], &[], &[("map", fixed([1, 3, 80, 80]))], &[("map_features", fixed([1, 3, 40, 40]))]);
    // The frame's square lies 8 px inside the crop.
    let inset = vec![8.0, -8.0, 8.0, -8.0, 8.0, 8.0, -8.0, -8.0];
    let refine = model(
        &[
            Node { op: "ReduceMean", inputs: vec!["frame"], outputs: vec!["f"], attributes: vec![over()] },
            Node { op: "ReduceMean", inputs: vec!["map_features"], outputs: vec!["m"], attributes: vec![over()] },
            Node { op: "Add", inputs: vec!["f", "m"], outputs: vec!["both"], attributes: vec![] },
            Node { op: "Mul", inputs: vec!["both", "zero"], outputs: vec!["nothing"], attributes: vec![] },
            Node { op: "Add", inputs: vec!["nothing", "inset"], outputs: vec!["displacement"], attributes: vec![] },
            Node {
                op: "ReduceMean",
                inputs: vec!["both"],
                outputs: vec!["residual"],
                attributes: vec![over(), ("keepdims", Attribute::Int(0))],
            },
        ],
        &[
            Constant { name: "zero", dims: vec![1], values: vec![0.0] },
            Constant { name: "inset", dims: vec![1, 2, 2, 2], values: inset },
        ],
        &[
            ("map_features", fixed([1, 3, 40, 40])),
            ("frame", vec![Size::Open("b"), Size::Fixed(2), Size::Fixed(64), Size::Fixed(64)]),
        ],
        &[
            ("displacement", vec![Size::Open("b"), Size::Fixed(2), Size::Fixed(2), Size::Fixed(2)]),
            ("residual", vec![Size::Open("b")]),
        ],
    );
    [("coarse_map", coarse_map), ("coarse", coarse), ("refine_map", refine_map), ("refine", refine)]
}

/// A smooth random landscape: brightness at any place, metres.
pub struct Landscape {
    waves: Vec<[f64; 4]>,
}

impl Landscape {
    pub fn new(seed: u64) -> Self {
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
        let mut wave = || {
            let (length_m, angle): (f64, f64) = (rng.random_range(18.0..70.0), rng.random_range(0.0..std::f64::consts::TAU));
            let k = std::f64::consts::TAU / length_m;
            [k * angle.cos(), k * angle.sin(), rng.random_range(0.0..std::f64::consts::TAU), rng.random_range(0.5..1.0)]
        };
        Self { waves: (0..60).map(|_| wave()).collect() }
    }
    pub fn level(&self, x: f64, y: f64) -> u8 {
        let sum: f64 = self.waves.iter().map(|[kx, ky, phase, size]| size * (kx * x + ky * y + phase).sin()).sum();
        (128.0 + 20.0 * sum).clamp(0.0, 255.0) as u8
    }
    /// A square about `(x, y)` window px, turned clockwise and scaled, gray.
    pub fn frame(&self, x: f64, y: f64, turn_deg: f64, scale: f64) -> Vec<u8> {
        let (sin, cos) = turn_deg.to_radians().sin_cos();
        let middle = (FRAME_PX as f64 - 1.0) / 2.0;
        let place = |i: usize| {
            let (u, v) = ((i % FRAME_PX) as f64 - middle, (i / FRAME_PX) as f64 - middle);
            self.level(x + scale * (cos * u - sin * v), y + scale * (sin * u + cos * v))
        };
        (0..FRAME_PX * FRAME_PX).map(place).collect()
    }
    /// The window with its margin, RGB.
    pub fn square(&self) -> Vec<u8> {
        let at = |i: usize| (i as f64) - MARGIN_PX as f64;
        (0..SQUARE_PX * SQUARE_PX).flat_map(|i| [self.level(at(i % SQUARE_PX), at(i / SQUARE_PX)); 3]).collect()
    }
}

/// The bundle in memory, without golden pair.
pub fn in_memory(runtime: &Runtime) -> Bundle {
    let manifest = Manifest::parse(&manifest_text(&[0; 0]), "fixture").expect("the fixture's manifest is valid");
    let [coarse_map, coarse, refine_map, refine] = graphs();
    let any = |name, rank: usize| Port { name, dims: vec![Dim::Any; rank] };
    let open = |(name, onnx): (&'static str, Vec<u8>), inputs: &[Port], outputs: &[Port]| {
        Graph::new(name, &onnx, runtime, inputs, outputs).expect("the fixture's graphs are valid")
    };
    Bundle {
        manifest,
        coarse_map: open(coarse_map, &[any("map", 4)], &[any("map_features", 4)]),
        coarse: open(coarse, &[any("frame", 4)], &[any("frame_features", 4)]),
        refine: Some((
            open(refine_map, &[any("map", 4)], &[any("map_features", 4)]),
            open(refine, &[any("map_features", 4), any("frame", 4)], &[any("displacement", 4), any("residual", 1)]),
        )),
        golden: Vec::new(),
    }
}

/// The manifest with the digests of these golden bytes and of the graphs.
pub fn manifest_text(golden: &[u8]) -> String {
    let digest = |bytes: &[u8]| Sha256::digest(bytes).iter().map(|b| format!("{b:02x}")).collect::<String>();
    let mut text = MANIFEST.replace("GOLDEN", &digest(golden));
    for (name, onnx) in graphs() {
        text = text.replace(&format!("\"{}\"", name.to_uppercase()), &format!("\"{}\"", digest(&onnx)));
    }
    text
}

/// Writes the bundle, golden pair and all.
pub fn write(folder: &Path, runtime: &Runtime) {
    let golden = npz(&golden_arrays(runtime));
    std::fs::create_dir_all(folder).unwrap();
    std::fs::write(folder.join("golden.npz"), &golden).unwrap();
    std::fs::write(folder.join("bundle.toml"), manifest_text(&golden)).unwrap();
    for (name, onnx) in graphs() {
        std::fs::write(folder.join(format!("{name}.onnx")), onnx).unwrap();
    }
}

/// Every array of the golden pair, in NumPy's format.
pub fn golden_arrays(runtime: &Runtime) -> Vec<(String, Vec<u8>)> {
    let land = Landscape::new(7);
    let (square, frame, seen) = (land.square(), land.frame(220.3, 170.8, 4.0, 1.02), vec![1; FRAME_PX * FRAME_PX]);
    let mut bundle = in_memory(runtime);
    let window = WindowView { size_px: SQUARE_PX, rgb: &square };
    let view = FrameView { size_px: FRAME_PX, gray: &frame, seen: &seen };
    let mut map = encode_map(&mut bundle, &window).unwrap();
    let search = Search::whole(&bundle.manifest);
    let found = match_pair(&mut bundle, &window, &mut map, &view, &search, &mut Steps::start()).unwrap();

    let mut arrays = vec![
        ("map_rgb".to_owned(), npy("|u1", &[SQUARE_PX, SQUARE_PX, 3], &square)),
        ("frame".to_owned(), npy("|u1", &[FRAME_PX, FRAME_PX], &frame)),
        ("final".to_owned(), npy("<f8", &[2, 2, 2], &le(found.final_displacement.iter().flatten().flatten()))),
        ("homography".to_owned(), npy("<f8", &[3, 3], &le(found.homography.0.iter().flatten()))),
    ];
    let ramp = |shape: &[usize]| Tensor {
        shape: shape.to_vec(),
        data: (0..shape.iter().product()).map(|i: usize| (i % 97) as f32 / 97.0).collect(),
    };
    let mut put = |graph: &str, side: &str, port: &str, tensor: &Tensor| {
        let data: Vec<u8> = tensor.data.iter().flat_map(|v| v.to_le_bytes()).collect();
        arrays.push((format!("{graph}.{side}.{port}"), npy("<f4", &tensor.shape, &data)));
    };
    let (map_input, crop) = (ramp(&[1, 3, 112, 112]), ramp(&[1, 3, 80, 80]));
    let (coarse_frame, refine_frame) = (ramp(&[2, 2, 32, 32]), ramp(&[1, 2, 64, 64]));
    let (refine_map, refine) = bundle.refine.as_mut().unwrap();
    let crop_features = refine_map.run(&[("map", &crop)]).unwrap();
    let features = crop_features.get("map_features").unwrap();
    for (name, graph, inputs) in [
        ("coarse_map", &mut bundle.coarse_map, vec![("map", &map_input)]),
        ("coarse", &mut bundle.coarse, vec![("frame", &coarse_frame)]),
        ("refine_map", refine_map, vec![("map", &crop)]),
        ("refine", refine, vec![("map_features", features), ("frame", &refine_frame)]),
    ] {
        for (port, tensor) in inputs.iter().filter(|(port, _)| *port != "map_features") {
            put(name, "in", port, tensor);
        }
        for (port, tensor) in &graph.run(&inputs).unwrap().named {
            put(name, "out", port, tensor);
        }
    }
    arrays
}

fn le<'a>(values: impl Iterator<Item = &'a f64>) -> Vec<u8> {
    values.flat_map(|v| v.to_le_bytes()).collect()
}

/// An array in NumPy's format 1.0.
pub fn npy(dtype: &str, shape: &[usize], data: &[u8]) -> Vec<u8> {
    let dims: String = shape.iter().map(|d| format!("{d}, ")).collect();
    npy_with(&format!("{{'descr': '{dtype}', 'fortran_order': False, 'shape': ({dims}), }}"), data)
}

/// The same with any header.
pub fn npy_with(header: &str, data: &[u8]) -> Vec<u8> {
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((header.len() as u16).to_le_bytes());
    bytes.extend(header.as_bytes());
    bytes.extend(data);
    bytes
}

/// Arrays packed as `np.savez_compressed` does.
pub fn npz(arrays: &[(String, Vec<u8>)]) -> Vec<u8> {
    let mut archive = zip::ZipWriter::new(std::io::Cursor::new(Vec::new()));
    let options = zip::write::SimpleFileOptions::default().compression_method(zip::CompressionMethod::Deflated);
    for (name, bytes) in arrays {
        archive.start_file(format!("{name}.npy"), options).unwrap();
        archive.write_all(bytes).unwrap();
    }
    archive.finish().unwrap().into_inner()
}
