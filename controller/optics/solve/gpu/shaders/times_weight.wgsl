// Pixels count by their weights.
@group(0) @binding(3) var<storage, read> weights: array<f32>;
fn weight_at(at: u32) -> f32 { return weights[at]; }
