//! Reads all channels of an EXR file as f32, by name.

use exr::prelude::*;
use std::collections::BTreeMap;
use std::path::Path;

/// Channels of the first layer, row-major from the top.
pub struct Picture {
    pub width: usize,
    pub height: usize,
    pub channels: BTreeMap<String, Vec<f32>>,
}

impl Picture {
    pub fn read(path: &Path) -> Picture {
        let image = read_first_flat_layer_from_file(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        let layer = image.layer_data;
        let channels = layer
            .channel_data
            .list
            .iter()
            .map(|c| (c.name.to_string(), c.sample_data.values_as_f32().collect()))
            .collect();
        Picture { width: layer.size.width(), height: layer.size.height(), channels }
    }

    pub fn channel(&self, name: &str) -> &[f32] {
        self.channels.get(name).unwrap_or_else(|| panic!("no channel {name}"))
    }
}
