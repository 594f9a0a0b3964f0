//! The sizes that JPEG and WebP chunks state about themselves, checked before their decoders allocate.

/// Fails unless the frame header of a JPEG stream states a size within a chunk's.
pub(super) fn check_jpeg(bytes: &[u8], (width, height): (u32, u32)) -> Result<(), String> {
    match jpeg_size(bytes)? {
        // Encoders may round strips up to whole blocks.
        Some((w, h)) if w <= width.next_multiple_of(16) && h <= height.next_multiple_of(16) => Ok(()),
        Some((w, h)) => Err(format!("a JPEG of {w} x {h} px in a chunk of {width} x {height}")),
        None => Err("a JPEG without a frame header".into()),
    }
}

/// Width and height in the frame header of a JPEG stream; `None` where there is none before the data or the end (tables).
pub(super) fn jpeg_size(bytes: &[u8]) -> Result<Option<(u32, u32)>, String> {
    let be16 = |at: usize| -> Option<u32> { Some(u32::from(u16::from_be_bytes([*bytes.get(at)?, *bytes.get(at + 1)?]))) };
    let mut at = 2;
    while let Some(&[first, marker]) = bytes.get(at..at + 2).and_then(|s| s.first_chunk::<2>()) {
        match (first, marker) {
            // Fill bytes, and markers that stand alone.
            (0xff, 0xff) => at += 1,
            (0xff, 0x01 | 0xd0..=0xd8) => at += 2,
            (0xff, 0xc0..=0xc3 | 0xc5..=0xc7 | 0xc9..=0xcb | 0xcd..=0xcf) => {
                let size = be16(at + 7).zip(be16(at + 5));
                return size.map(Some).ok_or_else(|| "a JPEG that ends in its header".into());
            }
            (0xff, 0xd9 | 0xda) => break,
            (0xff, _) => at += 2 + be16(at + 2).ok_or("a JPEG that ends in its header")? as usize,
            _ => break,
        }
    }
    Ok(None)
}

/// Fails unless a WebP stream states a size within a chunk's.
pub(super) fn check_webp(bytes: &[u8], (width, height): (u32, u32)) -> Result<(), String> {
    let le = |at: usize, count: usize| -> Option<u32> {
        bytes.get(at..at + count).map(|s| s.iter().rev().fold(0, |n, &b| (n << 8) | u32::from(b)))
    };
    let size = match bytes.get(12..16) {
        Some(b"VP8X") => le(24, 3).zip(le(27, 3)).map(|(w, h)| (w + 1, h + 1)),
        Some(b"VP8L") => le(21, 4).map(|bits| ((bits & 0x3fff) + 1, (bits >> 14 & 0x3fff) + 1)),
        Some(b"VP8 ") => le(26, 2).zip(le(28, 2)).map(|(w, h)| (w & 0x3fff, h & 0x3fff)),
        _ => None,
    };
    match size {
        Some((w, h)) if w <= width && h <= height => Ok(()),
        Some((w, h)) => Err(format!("a WebP image of {w} x {h} px in a chunk of {width} x {height}")),
        None => Err("no WebP header".into()),
    }
}
