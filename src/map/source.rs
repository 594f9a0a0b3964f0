//! The file itself: positioned reads that never disturb each other, and the small edits a decoder needs to see.

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::os::unix::fs::FileExt;
use std::sync::Arc;

/// An open file of known length. Clones share the descriptor: what was opened stays what is read, even where another file
/// takes its name.
#[derive(Debug, Clone)]
pub(super) struct Source {
    file: Arc<File>,
    len: u64,
}

impl Source {
    /// Wraps an open file.
    pub fn new(file: File) -> io::Result<Self> {
        let len = file.metadata()?.len();
        Ok(Self { file: Arc::new(file), len })
    }

    /// Length in bytes, when it was opened.
    pub fn len(&self) -> u64 {
        self.len
    }

    /// `count` bytes at `at`; `None` where they are not all inside the file. Nothing is allocated for what is not there.
    pub fn bytes(&self, at: u64, count: u64) -> Option<Vec<u8>> {
        if at.checked_add(count)? > self.len {
            return None;
        }
        let mut out = vec![0; usize::try_from(count).ok()?];
        self.file.read_exact_at(&mut out, at).ok()?;
        Some(out)
    }

    /// A reader that shows `patches` (offset, bytes) in place of what the file holds there.
    pub fn reader(&self, patches: Vec<(u64, Vec<u8>)>) -> PatchedReader {
        PatchedReader { source: self.clone(), at: 0, patches }
    }
}

/// A seekable view of a file with a few bytes replaced.
#[derive(Debug)]
pub(super) struct PatchedReader {
    source: Source,
    at: u64,
    patches: Vec<(u64, Vec<u8>)>,
}

impl Read for PatchedReader {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        let count = self.source.file.read_at(out, self.at)?;
        for (start, bytes) in &self.patches {
            for (at, &byte) in (*start..).zip(bytes) {
                let slot = at.checked_sub(self.at).and_then(|i| usize::try_from(i).ok()).filter(|&i| i < count);
                if let Some(slot) = slot.and_then(|i| out.get_mut(i)) {
                    *slot = byte;
                }
            }
        }
        self.at += count as u64;
        Ok(count)
    }
}

impl Seek for PatchedReader {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        let target = match to {
            SeekFrom::Start(at) => Some(at),
            SeekFrom::Current(by) => self.at.checked_add_signed(by),
            SeekFrom::End(by) => self.source.len.checked_add_signed(by),
        };
        self.at = target.ok_or_else(|| io::Error::new(io::ErrorKind::InvalidInput, "seek before the start"))?;
        Ok(self.at)
    }
}
