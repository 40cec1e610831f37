// Windows as they are kept: site, gain, and their shape in two words (see records.py).
@group(0) @binding(1) var<storage, read> records: array<vec4<u32>>;
