// Shares of windows of any size, whose rows are moved along x by their skew.
@group(0) @binding(3) var<storage, read> table: array<f32>;
// where a kind's rows begin in the table, and their length
@group(0) @binding(4) var<storage, read> kinds: array<vec2<u32>>;

fn wide_of(w: vec4<u32>) -> vec2<i32> { return vec2<i32>(kinds[(w.z & 0xffffu) >> PHASE_BITS]); }
fn high_of(w: vec4<u32>) -> vec2<i32> { return vec2<i32>(kinds[w.z >> (16u + PHASE_BITS)]); }

// The position of row j in x, in parts of a pixel, from the window's first column on.
fn moved(w: vec4<u32>, height: i32, j: i32) -> i32 {
  let fx = i32(w.z & 0xffu);
  let fy = i32((w.z >> 16u) & 0xffu);
  return fx + ((skew_of(w) * ((j - (height / 2 - 1)) * PHASES - fy)) >> SHEAR_BITS);
}

fn row_share(w: vec4<u32>, high: vec2<i32>, j: i32) -> f32 {
  return table[high.x + i32((w.z >> 16u) & 0xffu) * high.y + j];
}
