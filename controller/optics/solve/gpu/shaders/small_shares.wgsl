// Shares of windows of four by four pixels: a table row for x, one for y, and what couples them.
@group(0) @binding(3) var<storage, read> table: array<f32>;
@group(0) @binding(4) var<storage, read> skews: array<f32>;

fn share(w: vec4<u32>, i: i32, j: i32) -> f32 {
  let along = table[4u * (w.z & 0xffffu) + u32(i)];
  let upright = table[4u * (w.z >> 16u) + u32(j)];
  return along * upright * skews[16 * (SKEW_STEPS + skew_of(w)) + 4 * j + i];
}
