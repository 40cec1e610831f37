// All pixels count.
fn weight_at(at: u32) -> f32 { return 1.0; }
