// The picture less what is wanted.
@group(0) @binding(2) var<storage, read> wanted: array<f32>;
fn wanted_at(i: u32) -> f32 { return wanted[i]; }
