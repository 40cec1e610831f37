// Gains that make each window's shares sum to 1, for means over projector pixels.
@group(0) @binding(8) var<storage, read> even: array<f32>;
fn gain_of(e: u32, w: vec4<u32>) -> f32 { return even[e]; }
