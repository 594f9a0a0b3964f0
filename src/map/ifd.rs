//! TIFF directories, read with a bound on everything before anything is allocated.
//!
//! The `tiff` crate decodes the chunks; this reader sees the file first, so that counts, sizes and offsets which make no
//! sense never reach a decoder. Reference: TIFF 6.0 section 2; BigTIFF (Adobe/Aware Systems).

use super::source::Source;
use std::collections::BTreeMap;

/// Directories a file may hold (full image, overviews, masks).
const MAX_DIRECTORIES: usize = 64;
/// Entries a directory may hold.
const MAX_ENTRIES: u64 = 1024;
/// Values one entry may hold: the chunk offsets of a 500 000 x 500 000 px image in 256 px tiles.
pub(super) const MAX_VALUES: u64 = 1 << 22;

/// A flaw in the file's structure: field, expected, found.
pub(super) type Flaw = (&'static str, String, String);

/// One entry of a directory, its values still in the file.
#[derive(Debug, Clone, Copy)]
pub(super) struct Entry {
    kind: u16,
    count: u64,
    /// Where the values stand in the file (inside the entry where they fit).
    pub at: u64,
}

/// One image file directory.
#[derive(Debug, Clone)]
pub(super) struct Directory {
    /// Where it stands.
    pub at: u64,
    entries: BTreeMap<u16, Entry>,
}

/// The header and every directory of the main chain.
pub(super) struct Structure {
    pub big_tiff: bool,
    pub big_endian: bool,
    pub directories: Vec<Directory>,
}

/// Bytes of one value of a TIFF field type, `None` for unknown types.
fn kind_size(kind: u16) -> Option<u64> {
    match kind {
        1 | 2 | 6 | 7 => Some(1),
        3 | 8 => Some(2),
        4 | 9 | 11 | 13 => Some(4),
        5 | 10 | 12 | 16 | 17 | 18 => Some(8),
        _ => None,
    }
}

impl Structure {
    /// Reads the header and follows the chain of directories.
    pub fn read(source: &Source) -> Result<Self, Flaw> {
        let head = source.bytes(0, 8).ok_or_else(|| flaw("header", "at least 8 bytes", format!("{} bytes", source.len())))?;
        let big_endian = match head.get(..2) {
            Some(b"II") => false,
            Some(b"MM") => true,
            other => return Err(flaw("byte order", "`II` or `MM`", format!("{other:02x?}"))),
        };
        let mut this = Self { big_tiff: false, big_endian, directories: Vec::new() };
        let mut next = match this.number(head.get(2..4)) {
            42 => this.number(head.get(4..8)),
            43 => {
                this.big_tiff = true;
                let big = source.bytes(0, 16).ok_or_else(|| flaw("header", "16 bytes of BigTIFF header", "fewer"))?;
                let (size, zero) = (this.number(big.get(4..6)), this.number(big.get(6..8)));
                if (size, zero) != (8, 0) {
                    return Err(flaw("BigTIFF header", "offset size 8, then 0", format!("{size}, then {zero}")));
                }
                this.number(big.get(8..16))
            }
            other => return Err(flaw("TIFF version", "42, or 43 (BigTIFF)", other)),
        };
        while next != 0 {
            if this.directories.iter().any(|d| d.at == next) {
                return Err(flaw("directory chain", "an end", format!("a loop back to offset {next}")));
            }
            if this.directories.len() == MAX_DIRECTORIES {
                return Err(flaw("directory chain", format!("at most {MAX_DIRECTORIES} directories"), "more"));
            }
            let (directory, after) = this.directory(source, next)?;
            this.directories.push(directory);
            next = after;
        }
        if this.directories.is_empty() {
            return Err(flaw("directory chain", "at least one directory", "none"));
        }
        Ok(this)
    }

    fn directory(&self, source: &Source, at: u64) -> Result<(Directory, u64), Flaw> {
        let truncated = || flaw("directory", format!("inside the file of {} bytes", source.len()), format!("offset {at}"));
        let (count_bytes, entry_bytes, offset_bytes) = if self.big_tiff { (8, 20, 8) } else { (2, 12, 4) };
        let count = self.number(Some(&source.bytes(at, count_bytes).ok_or_else(truncated)?));
        if count == 0 || count > MAX_ENTRIES {
            return Err(flaw("directory entries", format!("1 to {MAX_ENTRIES}"), count));
        }
        let first = at.checked_add(count_bytes).ok_or_else(truncated)?;
        let body = source.bytes(first, count * entry_bytes + offset_bytes).ok_or_else(truncated)?;
        let mut entries = BTreeMap::new();
        for (i, raw) in (0..count).zip(body.chunks_exact(entry_bytes as usize)) {
            let (tag, kind) = (self.number(raw.get(..2)) as u16, self.number(raw.get(2..4)) as u16);
            let split = 4 + offset_bytes as usize;
            let values = self.number(raw.get(4..split));
            let Some(size) = kind_size(kind) else { continue };
            let inline = values.checked_mul(size).is_some_and(|bytes| bytes <= offset_bytes);
            let at = if inline { first + i * entry_bytes + split as u64 } else { self.number(raw.get(split..)) };
            // The first of two equal tags counts, as in libtiff.
            entries.entry(tag).or_insert(Entry { kind, count: values, at });
        }
        let after = self.number(body.get((count * entry_bytes) as usize..));
        Ok((Directory { at, entries }, after))
    }

    /// An unsigned number of up to eight bytes in the file's byte order; 0 for none.
    pub fn number(&self, bytes: Option<&[u8]>) -> u64 {
        let bytes = bytes.unwrap_or_default();
        let push = |n: u64, &b: &u8| (n << 8) | u64::from(b);
        if self.big_endian { bytes.iter().fold(0, push) } else { bytes.iter().rev().fold(0, push) }
    }

    /// The bytes of a field, after checking type and count.
    fn raw(
        &self,
        source: &Source,
        directory: &Directory,
        tag: (u16, &'static str),
        kinds: &[u16],
    ) -> Result<Option<(u16, Vec<u8>)>, Flaw> {
        let Some(entry) = directory.entries.get(&tag.0) else { return Ok(None) };
        if !kinds.contains(&entry.kind) {
            return Err(flaw(tag.1, format!("a field of type {kinds:?}"), format!("type {}", entry.kind)));
        }
        if entry.count > MAX_VALUES {
            return Err(flaw(tag.1, format!("at most {MAX_VALUES} values"), entry.count));
        }
        let size = entry.count * kind_size(entry.kind).unwrap_or(1);
        let bytes = source.bytes(entry.at, size).ok_or_else(|| {
            flaw(
                tag.1,
                format!("values inside the file of {} bytes", source.len()),
                format!("{size} bytes at offset {}", entry.at),
            )
        })?;
        Ok(Some((entry.kind, bytes)))
    }

    /// Unsigned integers (BYTE, SHORT, LONG, LONG8) of a tag; `None` where it is absent.
    pub fn unsigned(&self, source: &Source, directory: &Directory, tag: (u16, &'static str)) -> Result<Option<Vec<u64>>, Flaw> {
        let Some((kind, bytes)) = self.raw(source, directory, tag, &[1, 3, 4, 13, 16, 18])? else { return Ok(None) };
        let size = kind_size(kind).unwrap_or(1) as usize;
        Ok(Some(bytes.chunks_exact(size).map(|c| self.number(Some(c))).collect()))
    }

    /// The first unsigned integer of a tag; `None` where it is absent.
    pub fn unsigned1(&self, source: &Source, directory: &Directory, tag: (u16, &'static str)) -> Result<Option<u64>, Flaw> {
        match self.unsigned(source, directory, tag)? {
            None => Ok(None),
            Some(values) => values.first().copied().map(Some).ok_or_else(|| flaw(tag.1, "a value", "none")),
        }
    }

    /// Doubles of a tag; `None` where it is absent.
    pub fn doubles(&self, source: &Source, directory: &Directory, tag: (u16, &'static str)) -> Result<Option<Vec<f64>>, Flaw> {
        let Some((_, bytes)) = self.raw(source, directory, tag, &[12])? else { return Ok(None) };
        Ok(Some(bytes.chunks_exact(8).map(|c| f64::from_bits(self.number(Some(c)))).collect()))
    }

    /// Bytes of a tag of undefined type; `None` where it is absent.
    pub fn opaque(&self, source: &Source, directory: &Directory, tag: (u16, &'static str)) -> Result<Option<Vec<u8>>, Flaw> {
        Ok(self.raw(source, directory, tag, &[1, 7])?.map(|(_, bytes)| bytes))
    }

    /// Text of a tag up to its first NUL; `None` where it is absent.
    pub fn text(&self, source: &Source, directory: &Directory, tag: (u16, &'static str)) -> Result<Option<String>, Flaw> {
        let Some((_, bytes)) = self.raw(source, directory, tag, &[2])? else { return Ok(None) };
        Ok(Some(bytes.split(|&b| b == 0).next().map(|s| String::from_utf8_lossy(s).into_owned()).unwrap_or_default()))
    }
}

impl Directory {
    /// Where the single SHORT value of a tag stands in the file.
    pub fn short_at(&self, tag: u16) -> Option<u64> {
        self.entries.get(&tag).filter(|e| e.kind == 3 && e.count == 1).map(|e| e.at)
    }

    /// Whether a tag is there.
    pub fn has(&self, tag: u16) -> bool {
        self.entries.contains_key(&tag)
    }
}

/// A flaw from its parts.
pub(super) fn flaw(field: &'static str, expected: impl ToString, found: impl ToString) -> Flaw {
    (field, expected.to_string(), found.to_string())
}
