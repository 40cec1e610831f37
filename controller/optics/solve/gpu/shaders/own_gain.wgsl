// The windows' own gains: white light over the sum of shares.
fn gain_of(e: u32, w: vec4<u32>) -> f32 { return bitcast<f32>(w.y); }
