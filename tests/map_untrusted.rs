//! Damaged and hostile files: an error or a map, never a panic, never a giant allocation.

use nightfix::geo::{Affine, Crs};
use nightfix::map::{GeoTiff, MapCache, WindowSpec, write_rgb};
use proptest::prelude::*;
use std::path::Path;

/// A small valid map of 2 x 2 tiles.
fn valid(dir: &Path) -> Vec<u8> {
    let path = dir.join("valid.tif");
    let (width, height) = (300, 280);
    let rgb: Vec<u8> = (0..width * height * 3).map(|i: usize| (i * 7 % 251) as u8).collect();
    let affine = Affine([1.0, 0.0, 344_000.5, 0.0, -1.0, 2_790_000.5]);
    write_rgb(&path, &rgb, width, height, &affine, &Crs::from_epsg(32640).unwrap()).unwrap();
    std::fs::read(path).unwrap()
}

/// Opens the bytes as a map and makes a window; what went wrong, if something did.
fn try_map(dir: &Path, bytes: &[u8]) -> Result<f64, String> {
    let path = dir.join("damaged.tif");
    std::fs::write(&path, bytes).unwrap();
    let map = GeoTiff::open(&path).map_err(|e| e.to_string())?;
    let centre = map.centre().map_err(|e| e.to_string())?;
    let mut cache = MapCache::new(map, 1 << 20);
    let window = cache.window(&WindowSpec { centre, width_m: 256.0, m_per_px: 2.0 }).map_err(|e| e.to_string())?;
    cache.can_hold(centre, 100.0, 256.0, 0.9).map_err(|e| e.to_string())?;
    Ok(window.valid_fraction())
}

/// Where the directory's entry of a tag stands.
fn entry(bytes: &[u8], tag: u16) -> usize {
    let directory = u32::from_le_bytes(bytes[4..8].try_into().unwrap()) as usize;
    let count = u16::from_le_bytes(bytes[directory..directory + 2].try_into().unwrap()) as usize;
    let at = (0..count).map(|i| directory + 2 + 12 * i).find(|&at| bytes[at..at + 2] == tag.to_le_bytes());
    at.unwrap_or_else(|| panic!("no tag {tag}"))
}

/// Sets an entry's inline value (or offset).
fn set_value(bytes: &mut [u8], tag: u16, value: u32) {
    let at = entry(bytes, tag);
    bytes[at + 8..at + 12].copy_from_slice(&value.to_le_bytes());
}

/// Sets what a tag's values, which stand elsewhere, begin with.
fn set_far(bytes: &mut [u8], tag: u16, value: &[u8]) {
    let at = entry(bytes, tag);
    let far = u32::from_le_bytes(bytes[at + 8..at + 12].try_into().unwrap()) as usize;
    bytes[far..far + value.len()].copy_from_slice(value);
}

#[test]
fn the_whole_file_is_a_map() {
    let dir = tempfile::tempdir().unwrap();
    assert_eq!(try_map(dir.path(), &valid(dir.path())), Ok(1.0));
}

#[test]
fn a_truncated_file_is_an_error_that_says_so() {
    let dir = tempfile::tempdir().unwrap();
    let bytes = valid(dir.path());
    for end in (0..200).chain((200..bytes.len()).step_by(997)).chain(bytes.len() - 400..bytes.len() - 1) {
        let error = try_map(dir.path(), &bytes[..end]).expect_err(&format!("{end} of {} bytes", bytes.len()));
        assert!(error.contains("damaged.tif") && error.contains("expected"), "{error}");
    }
}

#[test]
fn every_contradiction_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let bytes = valid(dir.path());
    let zero = 0_f64.to_le_bytes();
    type Damage<'a> = &'a dyn Fn(&mut Vec<u8>);
    let cases: [(&str, Damage); 26] = [
        ("byte order", &|b| b[0] = b'X'),
        ("TIFF version", &|b| b[2] = 44),
        ("directory", &|b| b[4..8].fill(0xff)),
        ("directory chain", &|b| b[4..8].fill(0)),
        ("ImageWidth", &|b| set_value(b, 256, 0)),
        ("ImageWidth", &|b| set_value(b, 256, u32::MAX)),
        ("TileOffsets", &|b| set_value(b, 257, 4_000_000)),
        ("BitsPerSample", &|b| set_far(b, 258, &[32, 0, 32, 0, 32, 0])),
        ("BitsPerSample", &|b| set_far(b, 258, &[8, 0, 16, 0, 8, 0])),
        ("Compression", &|b| set_value(b, 259, 34_712)),
        ("PhotometricInterpretation", &|b| set_value(b, 262, 5)),
        ("SamplesPerPixel", &|b| set_value(b, 277, 0)),
        ("SamplesPerPixel", &|b| set_value(b, 277, 60_000)),
        ("PlanarConfiguration", &|b| set_value(b, 284, 3)),
        ("tile size", &|b| set_value(b, 322, 65_000).max_tile(b)),
        ("TileWidth", &|b| set_value(b, 322, 0)),
        ("TileOffsets", &|b| set_far(b, 324, &u32::MAX.to_le_bytes())),
        ("TileOffsets", &|b| set_far(b, 325, &u32::MAX.to_le_bytes())),
        ("TileOffsets", &|b| {
            let at = entry(b, 324);
            b[at + 4..at + 8].copy_from_slice(&u32::MAX.to_le_bytes());
        }),
        ("ModelPixelScale", &|b| set_far(b, 33550, &zero)),
        ("ModelPixelScale", &|b| set_far(b, 33550, &f64::NAN.to_le_bytes())),
        ("ModelPixelScale", &|b| set_far(b, 33550, &(-1.0_f64).to_le_bytes())),
        ("user-defined", &|b| set_far(b, 34735, &geo_keys(1, 3072, 32767))),
        ("ProjectedCRS", &|b| set_far(b, 34735, &geo_keys(1, 3072, 27700))),
        ("GTModelType", &|b| set_far(b, 34735, &geo_keys(3, 3072, 32640))),
        ("GeoKeyDirectory", &|b| {
            let at = entry(b, 34735);
            b[at..at + 2].copy_from_slice(&34_999_u16.to_le_bytes());
        }),
    ];
    for (i, (field, damage)) in cases.iter().enumerate() {
        let mut damaged = bytes.clone();
        damage(&mut damaged);
        let error = try_map(dir.path(), &damaged).expect_err(&format!("case {i}, {field}"));
        assert!(error.contains(field) && error.contains("damaged.tif"), "case {i}: `{field}` is not in: {error}");
    }
}

trait MaxTile {
    fn max_tile(self, bytes: &mut [u8]);
}
impl MaxTile for () {
    fn max_tile(self, bytes: &mut [u8]) {
        set_value(bytes, 323, 65_000);
    }
}

fn geo_keys(model: u16, key: u16, code: u16) -> Vec<u8> {
    [1, 1, 0, 3, 1024, 0, 1, model, 1025, 0, 1, 1, key, 0, 1, code].iter().flat_map(|v: &u16| v.to_le_bytes()).collect()
}

#[test]
fn a_chain_of_directories_that_bites_its_tail_is_an_error() {
    let dir = tempfile::tempdir().unwrap();
    let mut bytes = valid(dir.path());
    let directory = u32::from_le_bytes(bytes[4..8].try_into().unwrap()) as usize;
    let count = u16::from_le_bytes(bytes[directory..directory + 2].try_into().unwrap()) as usize;
    let next = directory + 2 + 12 * count;
    bytes[next..next + 4].copy_from_slice(&(directory as u32).to_le_bytes());
    let error = try_map(dir.path(), &bytes).unwrap_err();
    assert!(error.contains("loop"), "{error}");
}

#[test]
fn a_tile_that_does_not_decode_is_an_error_with_its_number() {
    let dir = tempfile::tempdir().unwrap();
    let mut bytes = valid(dir.path());
    bytes[20..4000].fill(0xa5);
    let error = try_map(dir.path(), &bytes).unwrap_err();
    assert!(error.contains("chunk 0"), "{error}");
}

#[test]
fn a_jpeg_tile_that_claims_to_be_huge_is_refused_before_it_is_decoded() {
    let dir = tempfile::tempdir().unwrap();
    let mut bytes = valid(dir.path());
    set_value(&mut bytes, 259, 7);
    let frame = [0xff, 0xd8, 0xff, 0xc0, 0, 17, 8, 0xff, 0xff, 0xff, 0xff, 3, 1, 0x11, 0, 2, 0x11, 0, 3, 0x11, 0];
    bytes[8..8 + frame.len()].copy_from_slice(&frame);
    let error = try_map(dir.path(), &bytes).unwrap_err();
    assert!(error.contains("65535 x 65535"), "{error}");
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, ..ProptestConfig::default() })]

    /// Any bytes of the directory and its values, any values: an answer comes back.
    #[test]
    fn flipped_bytes_never_panic(flips in prop::collection::vec((0.0..1.0_f64, any::<u8>()), 1..12)) {
        let dir = tempfile::tempdir().unwrap();
        let mut bytes = valid(dir.path());
        let directory = u32::from_le_bytes(bytes[4..8].try_into().unwrap()) as usize;
        let header: Vec<usize> = (0..8).chain(directory..bytes.len()).collect();
        for (share, value) in flips {
            let at = header[(share * header.len() as f64) as usize];
            bytes[at] = value;
        }
        let _ = try_map(dir.path(), &bytes);
    }

    /// The same for the compressed data.
    #[test]
    fn damaged_tiles_never_panic(at in 8_usize..20_000, value in any::<u8>(), compression in prop::sample::select(vec![1_u32, 5, 7, 8, 32_773, 50_000, 50_001])) {
        let dir = tempfile::tempdir().unwrap();
        let mut bytes = valid(dir.path());
        let directory = u32::from_le_bytes(bytes[4..8].try_into().unwrap()) as usize;
        set_value(&mut bytes, 259, compression);
        bytes[at.min(directory - 1)] = value;
        let _ = try_map(dir.path(), &bytes);
    }

    /// Not even a header.
    #[test]
    fn noise_never_panics(mut bytes in prop::collection::vec(any::<u8>(), 0..600), header in any::<bool>()) {
        if header && bytes.len() > 8 {
            bytes[..8].copy_from_slice(b"II\x2a\0\x08\0\0\0");
        }
        let dir = tempfile::tempdir().unwrap();
        prop_assert!(try_map(dir.path(), &bytes).is_err());
    }
}
