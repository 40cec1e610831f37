// Means of an estimate under the pixels.
@group(0) @binding(3) var<storage, read> sums: array<f32>;
@group(0) @binding(4) var<storage, read> per_sum: array<f32>;

fn start_of(c: u32, at: u32) -> f32 {
  let i = at + c * frame.pixels;
  return sums[i] * per_sum[i];
}
