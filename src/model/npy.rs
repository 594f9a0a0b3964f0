//! NumPy's `.npy` arrays of the four types a golden pair holds, with bounds before allocation.
//!
//! Reference: numpy.lib.format, versions 1.0 to 3.0. Our own reader because the header is untrusted: a general parser of
//! Python literals recurses as deep as the file says.

use std::io::Read;

/// Longest header, bytes: NumPy's own are under 200.
const MAX_HEADER_BYTES: usize = 4096;
/// Most dimensions.
const MAX_RANK: usize = 8;

/// An array, row-major.
#[derive(Debug, Clone, PartialEq)]
pub struct Array {
    /// Dimensions.
    pub shape: Vec<usize>,
    /// Values, as many as the shape's product.
    pub values: Values,
}

/// Values by type.
#[derive(Debug, Clone, PartialEq)]
pub enum Values {
    /// `|u1`
    U8(Vec<u8>),
    /// `<f4`
    F32(Vec<f32>),
    /// `<f8`
    F64(Vec<f64>),
}

impl Values {
    /// The type, for errors.
    pub fn dtype(&self) -> &'static str {
        match self {
            Self::U8(_) => "u8",
            Self::F32(_) => "f32",
            Self::F64(_) => "f64",
        }
    }
    /// Bytes in memory.
    pub fn bytes(&self) -> u64 {
        match self {
            Self::U8(v) => v.len() as u64,
            Self::F32(v) => 4 * v.len() as u64,
            Self::F64(v) => 8 * v.len() as u64,
        }
    }
    /// The bytes, if these are bytes.
    pub fn into_u8(self) -> Option<Vec<u8>> {
        if let Self::U8(v) = self { Some(v) } else { None }
    }
    /// The f32 values, if these are.
    pub fn into_f32(self) -> Option<Vec<f32>> {
        if let Self::F32(v) = self { Some(v) } else { None }
    }
    /// The f64 values, if these are.
    pub fn as_f64(&self) -> Option<&[f64]> {
        if let Self::F64(v) = self { Some(v) } else { None }
    }
}

/// Reads one array of at most `limit` bytes.
pub fn read(mut from: impl Read, limit: u64) -> Result<Array, String> {
    let mut prelude = [0u8; 8];
    from.read_exact(&mut prelude).map_err(|e| format!("npy: {e}"))?;
    let [magic @ .., major, _minor] = prelude;
    if magic != *b"\x93NUMPY" {
        return Err("npy: expected the magic bytes, found others".into());
    }
    let header_bytes = match major {
        1 => {
            let mut length = [0u8; 2];
            from.read_exact(&mut length).map_err(|e| format!("npy: {e}"))?;
            usize::from(u16::from_le_bytes(length))
        }
        2 | 3 => {
            let mut length = [0u8; 4];
            from.read_exact(&mut length).map_err(|e| format!("npy: {e}"))?;
            u32::from_le_bytes(length) as usize
        }
        _ => return Err(format!("npy: expected version 1 to 3, found {major}")),
    };
    if header_bytes > MAX_HEADER_BYTES {
        return Err(format!("npy: expected a header of at most {MAX_HEADER_BYTES} bytes, found {header_bytes}"));
    }
    let mut header = vec![0u8; header_bytes];
    from.read_exact(&mut header).map_err(|e| format!("npy: {e}"))?;
    let header = std::str::from_utf8(&header).map_err(|_| "npy: expected a header in UTF-8".to_owned())?;
    let (dtype, shape) = parse_header(header)?;
    let size = match dtype {
        "|u1" => 1,
        "<f4" => 4,
        "<f8" => 8,
        other => return Err(format!("npy: expected |u1, <f4 or <f8, found {}", other.escape_debug())),
    };
    let elements = shape.iter().try_fold(1u64, |n, &d| n.checked_mul(d as u64));
    let bytes = elements.and_then(|n| n.checked_mul(size)).filter(|&bytes| bytes <= limit);
    let bytes = bytes.ok_or_else(|| format!("npy: expected at most {limit} bytes, found shape {shape:?} of {dtype}"))?;
    let mut data = Vec::new();
    from.take(bytes).read_to_end(&mut data).map_err(|e| format!("npy: {e}"))?;
    if data.len() as u64 != bytes {
        return Err(format!("npy: expected {bytes} bytes of data, found {}", data.len()));
    }
    let values = match dtype {
        "|u1" => Values::U8(data),
        "<f4" => Values::F32(data.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect()),
        _ => Values::F64(data.as_chunks::<8>().0.iter().map(|b| f64::from_le_bytes(*b)).collect()),
    };
    Ok(Array { shape, values })
}

/// `{'descr': '<f4', 'fortran_order': False, 'shape': (1, 3), }`: type and shape.
fn parse_header(header: &str) -> Result<(&str, Vec<usize>), String> {
    let after = |key: &str| -> Result<&str, String> {
        let (_, rest) = header.split_once(key).ok_or_else(|| format!("npy: expected {key} in the header, found none"))?;
        Ok(rest.trim_start().strip_prefix(':').unwrap_or("").trim_start())
    };
    let descr = after("'descr'")?;
    let dtype = descr.strip_prefix('\'').and_then(|d| d.split_once('\'')).map(|(d, _)| d);
    let dtype = dtype.ok_or("npy: expected a plain type, found a structure")?;
    if !after("'fortran_order'")?.starts_with("False") {
        return Err("npy: expected C order, found Fortran order".into());
    }
    let shape = after("'shape'")?.strip_prefix('(').and_then(|s| s.split_once(')')).map(|(s, _)| s);
    let shape = shape.ok_or("npy: expected a shape in parentheses, found none")?;
    let dims = shape.split(',').map(str::trim).filter(|d| !d.is_empty());
    let dims: Result<Vec<usize>, _> = dims.map(str::parse).collect();
    let dims = dims.map_err(|_| format!("npy: expected a shape of whole numbers, found ({})", shape.escape_debug()))?;
    if dims.len() > MAX_RANK {
        return Err(format!("npy: expected at most {MAX_RANK} dimensions, found {}", dims.len()));
    }
    Ok((dtype, dims))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn npy(header: &str, data: &[u8]) -> Vec<u8> {
        let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
        bytes.extend((header.len() as u16).to_le_bytes());
        bytes.extend(header.as_bytes());
        bytes.extend(data);
        bytes
    }

    #[test]
    fn an_array_as_numpy_writes_it() {
        let data: Vec<u8> = [1.5f32, -2.0].iter().flat_map(|v| v.to_le_bytes()).collect();
        let bytes = npy("{'descr': '<f4', 'fortran_order': False, 'shape': (1, 2), }          \n", &data);
        assert_eq!(read(&bytes[..], 8).unwrap(), Array { shape: vec![1, 2], values: Values::F32(vec![1.5, -2.0]) });
        let scalar = npy("{'descr': '|u1', 'fortran_order': False, 'shape': (), }", &[7]);
        assert_eq!(read(&scalar[..], 8).unwrap(), Array { shape: vec![], values: Values::U8(vec![7]) });
    }

    #[test]
    fn shapes_beyond_the_limit_are_refused_before_allocation() {
        for shape in ["(1099511627776,)", "(18446744073709551615, 18446744073709551615)", "(3,)", "(99999999999999999999,)"] {
            let bytes = npy(&format!("{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}"), &[0; 8]);
            assert!(read(&bytes[..], 8).unwrap_err().starts_with("npy: expected"), "{shape}");
        }
    }

    #[test]
    fn every_truncation_and_odd_header_is_an_error() {
        let whole = npy("{'descr': '<f8', 'fortran_order': False, 'shape': (1,), }", &[0; 8]);
        for length in 0..whole.len() {
            assert!(read(&whole[..length], 8).is_err(), "{length} bytes");
        }
        for header in [
            "{'descr': '<f4', 'fortran_order': True, 'shape': (1,), }",
            "{'descr': '>f4', 'fortran_order': False, 'shape': (1,), }",
            "{'descr': [('a', '<f4')], 'fortran_order': False, 'shape': (1,), }",
            "{'descr': '<f4', 'fortran_order': False, 'shape': (-1,), }",
            "{'descr': '<f4', 'fortran_order': False, 'shape': (1,1,1,1,1,1,1,1,1), }",
            "{'descr': '<f4', 'fortran_order': False, }",
            "",
        ] {
            assert!(read(&npy(header, &[0; 8])[..], 8).is_err(), "{header}");
        }
        let mut huge_header = b"\x93NUMPY\x02\x00".to_vec();
        huge_header.extend(u32::MAX.to_le_bytes());
        assert!(read(&huge_header[..], 8).unwrap_err().contains("header of at most"));
    }
}
