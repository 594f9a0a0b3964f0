//! Bundles as untrusted input: what is right opens, what is not is refused with its name, and nothing aborts.

mod support;

use nightfix::model::{Bundle, BundleError};
use std::path::Path;
use support::bundle::{golden_arrays, manifest_text, npy_with, npz, runtime, write};

fn open(folder: &Path) -> Result<Bundle, BundleError> {
    Bundle::open(folder, &runtime())
}

/// A bundle whose golden pair has other arrays, with a digest that fits.
fn with_golden(folder: &Path, golden: &[u8]) -> String {
    std::fs::write(folder.join("golden.npz"), golden).unwrap();
    std::fs::write(folder.join("bundle.toml"), manifest_text(golden)).unwrap();
    open(folder).map(|_| ()).unwrap_err().to_string()
}

#[test]
fn a_right_bundle_opens_and_reports_its_golden_pair() {
    let folder = tempfile::tempdir().unwrap();
    write(folder.path(), &runtime());
    let bundle = open(folder.path()).unwrap();
    let arrays: Vec<_> = bundle.golden.iter().map(|line| line.array.as_str()).collect();
    for array in ["coarse_map.out.map_features", "coarse.out.frame_features", "refine.out.displacement", "final", "homography"] {
        assert!(arrays.contains(&array), "{arrays:?}");
    }
    assert!(bundle.golden.iter().all(|line| line.difference <= line.tolerance));
}

#[test]
fn every_field_mutated_is_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    write(folder.path(), &runtime());
    let right = std::fs::read_to_string(folder.path().join("bundle.toml")).unwrap();
    for (from, to, named) in [
        ("schema = 1", "schema = 2", "schema"),
        ("schema = 1\n", "", "schema"),
        ("schema = 1", "schema = 1\nextra = 1", "extra"),
        ("name = \"fixture\"", "name = \"\"", "name"),
        ("window_width_m = 384", "window_width_m = nan", "window_width_m"),
        ("window_width_m = 384", "window_width_m = 384.5", "window_width_m"),
        ("window_width_m = 384", "window_width_m = 1e300", "window_width_m"),
        ("window_margin_m = 32", "window_margin_m = -32", "window_margin_m"),
        ("frame_width_m = 128", "frame_width_m = 1000", "frame_width_m"),
        ("m_per_px = 1\n", "m_per_px = 0.5\n", "m_per_px"),
        ("search_radius_m = 128", "search_radius_m = inf", "search_radius_m"),
        ("tone_mapping = 1", "tone_mapping = 99", "tone_mapping"),
        ("kind = \"correlation\"", "kind = \"iterative\"", "iterative"),
        ("kind = \"matcher\"", "kind = \"correlation\"", "refine"),
        ("\"coarse.onnx\"", "\"../coarse.onnx\"", "coarse.graph.file"),
        ("\"coarse.onnx\"", "\"/dev/zero\"", "coarse.graph.file"),
        ("\"coarse.onnx\"", "\"absent.onnx\"", "absent.onnx"),
        ("\"golden.npz\"", "\"\"", "golden.file"),
        ("stride = 2", "stride = 0", "coarse.stride"),
        ("stride = 2", "stride = 5", "coarse.stride"),
        ("stride = 2", "stride = 4", "frame_features"),
        ("[-10.0, -5.0, 0.0, 5.0, 10.0]", "[]", "rotations_deg"),
        ("[-10.0, -5.0, 0.0, 5.0, 10.0]", "[nan]", "rotations_deg"),
        ("[0.9, 1.0, 1.1]", "[0.0]", "scales"),
        ("subcell_radius = 2", "subcell_radius = 4000000000", "subcell_radius"),
        ("tolerance = 1e-4", "tolerance = 0", "coarse.tolerance"),
        ("match_sigma_m = 3.0", "match_sigma_m = nan", "match_sigma_m"),
        ("size_px = 112", "size_px = 4294967295", "coarse.map.size_px"),
        ("size_px = 112", "size_px = 224", "coarse.frame.size_px"),
        ("width_m = 448", "width_m = 384", "coarse.map.width_m"),
        ("size_px = 32", "size_px = 16", "coarse.frame.size_px"),
        ("size_px = 80", "size_px = 96", "map"),
        ("size_px = 64", "size_px = 60", "frame"),
        ("content = \"rgb\"", "content = \"gray\"", "content"),
        ("content = \"gray_mask\"", "content = \"gray\"", "frame"),
        ("resize = \"supersample\"", "resize = \"align_corners_bilinear\"", "refine.map.resize"),
        ("shape = \"oriented\"", "shape = \"bounding_box\"", "refine.map.resize"),
        ("padding_m = 16", "padding_m = -1", "padding_m"),
        ("padding_m = 16", "padding_m = 20", "refine.map.width_m"),
        ("[refine.crop]\nshape = \"oriented\"\npadding_m = 16", "", "crop"),
        ("lookup = \"frame_indexed\"", "lookup = \"sideways\"", "sideways"),
    ] {
        assert!(right.contains(from), "{from}");
        std::fs::write(folder.path().join("bundle.toml"), right.replacen(from, to, 1)).unwrap();
        let error = open(folder.path()).map(|_| ()).expect_err(&format!("{from} -> {to}")).to_string();
        assert!(error.contains(named), "{from} -> {to}: {error}");
    }
}

#[test]
fn an_unknown_field_is_named_with_its_line() {
    let folder = tempfile::tempdir().unwrap();
    write(folder.path(), &runtime());
    let text = std::fs::read_to_string(folder.path().join("bundle.toml")).unwrap();
    std::fs::write(folder.path().join("bundle.toml"), text.replacen("opset = 17", "opset = 17\nopsett = 17", 1)).unwrap();
    let error = open(folder.path()).map(|_| ()).unwrap_err().to_string();
    assert!(error.contains("line 12") && error.contains("opsett"), "{error}");
}

#[test]
fn files_that_are_missing_changed_or_no_files_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    write(folder.path(), &runtime());
    let coarse = folder.path().join("coarse.onnx");
    let mut onnx = std::fs::read(&coarse).unwrap();
    *onnx.last_mut().unwrap() ^= 1;
    std::fs::write(&coarse, &onnx).unwrap();
    let error = open(folder.path()).map(|_| ()).unwrap_err().to_string();
    assert!(error.contains("coarse.onnx") && error.contains("sha256"), "{error}");
    std::fs::remove_file(&coarse).unwrap();
    assert!(open(folder.path()).map(|_| ()).unwrap_err().to_string().contains("coarse.onnx"));
    std::os::unix::fs::symlink("/dev/zero", &coarse).unwrap();
    assert!(open(folder.path()).map(|_| ()).unwrap_err().to_string().contains("regular file"));
    assert!(open(Path::new("/no/such/folder")).map(|_| ()).unwrap_err().to_string().contains("bundle.toml"));
}

#[test]
fn a_golden_pair_that_is_cut_crafted_or_wrong_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    write(folder.path(), &runtime());
    let arrays = golden_arrays(&runtime());
    let whole = npz(&arrays);
    for length in (0..whole.len()).step_by(whole.len() / 17) {
        assert!(with_golden(folder.path(), &whole[..length]).contains("golden.npz"), "{length}");
    }
    let change = |name: &str, bytes: Option<Vec<u8>>| {
        let mut changed = arrays.clone();
        let at = changed.iter().position(|(key, _)| key == name).unwrap();
        match bytes {
            Some(bytes) => changed[at].1 = bytes,
            None => drop(changed.remove(at)),
        }
        npz(&changed)
    };
    let header = |shape: &str| npy_with(&format!("{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}"), &[0; 8]);
    for (array, bytes, says) in [
        ("map_rgb", None, "map_rgb"),
        ("final", None, "final"),
        ("coarse.out.frame_features", None, "coarse.out.frame_features"),
        ("coarse.in.frame", Some(header("(1000000000000,)")), "at most"),
        ("coarse.in.frame", Some(header("(2, 2, 32, 32)")), "bytes of data"),
        ("coarse.in.frame", Some(header("(2,)")), "frame"),
        ("frame", Some(header("(2,)")), "frame"),
        ("homography", Some(header("(2,)")), "homography"),
    ] {
        let error = with_golden(folder.path(), &change(array, bytes));
        assert!(error.contains(says), "{array}: {error}");
    }
    // One number off by more than the tolerance: not the network that was exported.
    let mut off = arrays.iter().find(|(name, _)| name == "refine.out.displacement").unwrap().1.clone();
    let value = off.len() - 4;
    off[value..].copy_from_slice(&(-8.001f32).to_le_bytes());
    let error = with_golden(folder.path(), &change("refine.out.displacement", Some(off)));
    assert!(error.contains("refine.out.displacement") && error.contains("difference"), "{error}");
    // The pipeline gives another place.
    let mut moved = arrays.iter().find(|(name, _)| name == "final").unwrap().1.clone();
    let value = moved.len() - 8;
    moved[value..].copy_from_slice(&f64::NAN.to_le_bytes());
    let error = with_golden(folder.path(), &change("final", Some(moved)));
    assert!(error.contains("golden.npz: final"), "{error}");
}

/// Deflated zeros: a small file that states, or hides, more than the bounds.
#[test]
fn a_golden_pair_that_grows_when_unpacked_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    write(folder.path(), &runtime());
    let mut bomb = npy_with("{'descr': '|u1', 'fortran_order': False, 'shape': (600000000,), }", &[]);
    bomb.resize(bomb.len() + 600_000_000, 0);
    let packed = npz(&[("map_rgb".to_owned(), bomb)]);
    assert!(packed.len() < 1 << 20);
    assert!(with_golden(folder.path(), &packed).contains("at most"));
}

#[test]
fn garbage_graphs_are_errors() {
    let folder = tempfile::tempdir().unwrap();
    write(folder.path(), &runtime());
    let text = std::fs::read_to_string(folder.path().join("bundle.toml")).unwrap();
    let [_, (_, coarse), ..] = support::bundle::graphs();
    for garbage in [vec![], vec![0xff; 100], coarse[..coarse.len() / 2].to_vec()] {
        std::fs::write(folder.path().join("coarse.onnx"), &garbage).unwrap();
        let digest = |bytes: &[u8]| {
            use sha2::Digest;
            sha2::Sha256::digest(bytes).iter().map(|b| format!("{b:02x}")).collect::<String>()
        };
        std::fs::write(folder.path().join("bundle.toml"), text.replace(&digest(&coarse), &digest(&garbage))).unwrap();
        assert!(open(folder.path()).map(|_| ()).unwrap_err().to_string().contains("coarse"));
    }
}
