//! Decoded tiles that are kept, within a bound of bytes; the longest unused goes first.

use super::decode::{ChunkReader, Tile};
use super::{GeoTiff, MapError};
use std::collections::HashMap;
use std::sync::Arc;

/// The tiles of one map.
pub(super) struct Tiles {
    reader: ChunkReader,
    /// By level and chunk, with the time of the last use.
    kept: HashMap<(usize, u32), (Arc<Tile>, u64)>,
    bytes: usize,
    capacity_bytes: usize,
    clock: u64,
}

impl Tiles {
    /// Keeps at most `capacity_bytes` of decoded tiles, and always the one in use.
    pub fn new(map: &GeoTiff, capacity_bytes: usize) -> Self {
        Self { reader: ChunkReader::new(map), kept: HashMap::new(), bytes: 0, capacity_bytes, clock: 0 }
    }

    /// The tile, decoded or kept; `None` where the file has none.
    pub fn get(&mut self, map: &GeoTiff, level: usize, chunk: u32) -> Result<Option<Arc<Tile>>, MapError> {
        self.clock += 1;
        if let Some((tile, used)) = self.kept.get_mut(&(level, chunk)) {
            *used = self.clock;
            return Ok(Some(tile.clone()));
        }
        let Some(tile) = self.reader.tile(map, level, chunk)?.map(Arc::new) else { return Ok(None) };
        self.bytes += tile.bytes();
        while self.bytes > self.capacity_bytes {
            let Some(oldest) = self.kept.iter().min_by_key(|(_, (_, used))| *used).map(|(key, _)| *key) else { break };
            if let Some((gone, _)) = self.kept.remove(&oldest) {
                self.bytes -= gone.bytes();
            }
        }
        self.kept.insert((level, chunk), (tile.clone(), self.clock));
        Ok(Some(tile))
    }
}
