// What the kernels over windows share: a band of a projector's rows, and its windows (see records.py).
struct Band {
  columns: i32,
  rows: i32,
  first_row: i32,
  end_row: i32,
  place_row: i32,
  place_columns: i32,
  own_row: u32,
  pixels: u32,
  blocks: i32,
  // camera channel by projector channel, rows
  mixing: array<vec4<f32>, 3>,
}

@group(0) @binding(0) var<uniform> band: Band;
@group(0) @binding(2) var<storage, read> first: array<u32>;

fn left_of(w: vec4<u32>) -> i32 { return i32(w.w & 0xffffu) - MARGIN; }
fn skew_of(w: vec4<u32>) -> i32 { return i32((w.w >> 16u) & 0xffu) - 128; }
fn colour_of(w: vec4<u32>) -> u32 { return w.w >> 24u; }
// the value in its window's colour; not all compilers can write to a component by number
fn coloured(w: vec4<u32>, value: f32) -> vec3<f32> {
  return select(vec3<f32>(0.0), vec3<f32>(value), vec3<u32>(colour_of(w)) == vec3<u32>(0u, 1u, 2u));
}
