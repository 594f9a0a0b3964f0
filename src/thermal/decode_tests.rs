//! Round trips, colour weights, limits, and bytes nobody should send.

use super::*;
use image::{GrayImage, ImageBuffer, Luma, RgbImage};
use proptest::prelude::*;

fn encoded(image: impl Into<DynamicImage>, format: ImageFormat) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    image.into().write_to(&mut bytes, format).map(|()| bytes.into_inner()).unwrap_or_default()
}

fn ramp16(width: u32, height: u32) -> ImageBuffer<Luma<u16>, Vec<u16>> {
    ImageBuffer::from_fn(width, height, |x, y| Luma([(x * 523 + y * 7919) as u16]))
}

fn y16le(samples: &[u16]) -> Vec<u8> {
    samples.iter().flat_map(|v| v.to_le_bytes()).collect()
}

fn failing_field(result: Result<RawFrame, FrameError>) -> Option<&'static str> {
    match result {
        Err(FrameError::Field { field, .. }) => Some(field),
        _ => None,
    }
}

#[test]
fn encodings_by_name_and_by_ending() {
    for (name, file, encoding) in [
        ("png", "a/b.PNG", Encoding::Png),
        ("tiff", "b.tif", Encoding::Tiff),
        ("jpeg", "b.jpg", Encoding::Jpeg),
        ("y16le", "b.raw", Encoding::Y16le),
    ] {
        assert_eq!(name.parse(), Ok(encoding));
        assert_eq!(serde_json::to_value(encoding).ok(), Some(serde_json::Value::from(name)));
        assert_eq!(Encoding::of_file(Path::new(file)), Some(encoding));
    }
    assert!("PNG".parse::<Encoding>().is_err());
    assert_eq!(Encoding::of_file(Path::new("png")), None);
}

#[test]
fn sixteen_bits_survive_png_tiff_and_raw() -> Result<(), FrameError> {
    let image = ramp16(61, 37);
    let expected = RawFrame { width: 61, height: 37, samples: Samples::U16(image.as_raw().clone()) };
    assert_eq!(decode(&encoded(image.clone(), ImageFormat::Png), Encoding::Png, None)?, expected);
    assert_eq!(decode(&encoded(image.clone(), ImageFormat::Tiff), Encoding::Tiff, Some((61, 37)))?, expected);
    assert_eq!(decode(&y16le(image.as_raw()), Encoding::Y16le, Some((61, 37)))?, expected);
    Ok(())
}

#[test]
fn eight_bits_stay_eight_bits() -> Result<(), FrameError> {
    let image = GrayImage::from_fn(40, 30, |x, y| Luma([(x * 5 + y) as u8]));
    for (format, encoding) in [(ImageFormat::Png, Encoding::Png), (ImageFormat::Tiff, Encoding::Tiff)] {
        assert_eq!(decode(&encoded(image.clone(), format), encoding, None)?.samples, Samples::U8(image.as_raw().clone()));
    }
    let jpeg = decode(&encoded(image.clone(), ImageFormat::Jpeg), Encoding::Jpeg, None)?;
    let Samples::U8(found) = jpeg.samples else { return Err(field("samples", "8 bit".into(), "16 bit".into())) };
    assert!(found.iter().zip(image.as_raw()).all(|(a, b)| a.abs_diff(*b) < 12), "lossy, but this far off is another picture");
    Ok(())
}

#[test]
fn colour_becomes_luma_by_the_published_weights() -> Result<(), FrameError> {
    // Pillow 12: Image.new("RGB", (1, 1), c).convert("L").getpixel((0, 0))
    let cases = [
        ([255, 0, 0], 76),
        ([0, 255, 0], 150),
        ([0, 0, 255], 29),
        ([255, 255, 255], 255),
        ([10, 200, 30], 124),
        ([77, 77, 77], 77),
    ];
    for (rgb, luma) in cases {
        let image = RgbImage::from_pixel(9, 9, image::Rgb(rgb));
        let frame = decode(&encoded(image.clone(), ImageFormat::Png), Encoding::Png, None)?;
        assert_eq!(frame.samples, Samples::U8(vec![luma; 81]), "{rgb:?}");
        let with_alpha = DynamicImage::ImageRgb8(image).to_rgba8();
        assert_eq!(decode(&encoded(with_alpha, ImageFormat::Png), Encoding::Png, None)?.samples, Samples::U8(vec![luma; 81]));
    }
    for v in [0, 1, 32_767, 65_535] {
        assert_eq!(luma16([v; 3]), v);
    }
    Ok(())
}

#[test]
fn sizes_that_do_not_fit_name_the_field() {
    let png = encoded(ramp16(20, 10), ImageFormat::Png);
    assert_eq!(failing_field(decode(&png, Encoding::Png, Some((21, 10)))), Some("width"));
    assert_eq!(failing_field(decode(&png, Encoding::Png, Some((20, 11)))), Some("height"));
    let raw = y16le(&[0; 200]);
    assert_eq!(failing_field(decode(&raw, Encoding::Y16le, None)), Some("width"));
    for (size, name) in [
        ((0, 10), "width"),
        ((20, 0), "height"),
        ((4097, 1), "width"),
        ((1, u32::MAX), "height"),
        ((20, 11), "payload"),
        ((20, 9), "payload"),
    ] {
        assert_eq!(failing_field(decode(&raw, Encoding::Y16le, Some(size))), Some(name), "{size:?}");
    }
    assert_eq!(failing_field(decode(&[1, 2, 3], Encoding::Y16le, Some((1, 1)))), Some("payload"));
}

/// Headers that announce far more than 4096 x 4096 px, and what else is broken in the world.
#[test]
fn malformed_bytes_are_errors() {
    let png = encoded(ramp16(20, 10), ImageFormat::Png);
    let tiff = encoded(ramp16(20, 10), ImageFormat::Tiff);
    let jpeg = encoded(GrayImage::from_pixel(20, 10, Luma([9])), ImageFormat::Jpeg);
    let mut giant_png = png.clone();
    giant_png.splice(16..24, [0x7f, 0xff, 0xff, 0xff, 0x7f, 0xff, 0xff, 0xff]);
    let mut giant_jpeg = jpeg.clone();
    if let Some(at) = jpeg.windows(2).position(|w| w == [0xff, 0xc0]) {
        giant_jpeg.splice(at + 5..at + 9, [0xff; 4]);
    }
    let float = DynamicImage::ImageRgb32F(ImageBuffer::from_pixel(4, 4, image::Rgb([0.5; 3])));
    let wide = encoded(GrayImage::new(4097, 1), ImageFormat::Png);
    let cases = [
        ("empty", Encoding::Png, Vec::new()),
        ("no header", Encoding::Tiff, vec![0; 1000]),
        ("one for the other", Encoding::Jpeg, png.clone()),
        ("one for the other", Encoding::Png, jpeg.clone()),
        ("one for the other", Encoding::Tiff, jpeg.clone()),
        ("half a PNG", Encoding::Png, png[..png.len() / 2].to_vec()),
        ("half a TIFF", Encoding::Tiff, tiff[..tiff.len() / 2].to_vec()),
        ("giant PNG", Encoding::Png, giant_png),
        ("giant JPEG", Encoding::Jpeg, giant_jpeg),
        ("floating point", Encoding::Tiff, encoded(float, ImageFormat::Tiff)),
        ("too wide", Encoding::Png, wide),
        ("a TIFF that points at itself", Encoding::Tiff, vec![b'I', b'I', 42, 0, 8, 0, 0, 0, 0, 0, 8, 0, 0, 0]),
    ];
    for (what, encoding, bytes) in cases {
        let result = decode(&bytes, encoding, None);
        assert!(result.is_err(), "{what} as {encoding:?}: {:?}", result.map(|f| (f.width, f.height)));
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]

    /// Valid files with bytes changed, cut and repeated: an error or a frame of the size it says, never a panic.
    #[test]
    fn mutations_never_panic(
        kind in 0_usize..4,
        changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..8),
        end in any::<prop::sample::Index>(),
        cut in any::<bool>(),
    ) {
        let (mut bytes, encoding) = match kind {
            0 => (encoded(ramp16(33, 17), ImageFormat::Png), Encoding::Png),
            1 => (encoded(ramp16(33, 17), ImageFormat::Tiff), Encoding::Tiff),
            2 => (encoded(GrayImage::from_fn(33, 17, |x, y| Luma([(x * y) as u8])), ImageFormat::Jpeg), Encoding::Jpeg),
            _ => (encoded(RgbImage::from_fn(33, 17, |x, y| image::Rgb([x as u8, y as u8, 7])), ImageFormat::Tiff), Encoding::Tiff),
        };
        for (at, value) in &changes {
            let at = at.index(bytes.len());
            bytes[at] = *value;
        }
        if cut {
            bytes.truncate(end.index(bytes.len()));
        }
        if let Ok(frame) = decode(&bytes, encoding, None) {
            let expected = frame.width as usize * frame.height as usize;
            prop_assert_eq!(expected, match &frame.samples { Samples::U8(v) => v.len(), Samples::U16(v) => v.len() });
        }
    }

    #[test]
    fn random_bytes_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..400), kind in 0_usize..4, size in any::<Option<(u32, u32)>>()) {
        let encoding = [Encoding::Png, Encoding::Tiff, Encoding::Jpeg, Encoding::Y16le][kind];
        let _ = decode(&bytes, encoding, size);
    }
}
