// Writes where a solve starts: ``start_of`` of the file before, within bounds; pixels that light nothing stay dark.
@group(0) @binding(1) var<storage, read> majoriser: array<f32>;
@group(0) @binding(2) var<storage, read_write> x: array<f32>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
  let at = index_of(id, groups);
  if (at >= frame.pixels) { return; }
  for (var c = 0u; c < 3u; c++) {
    let i = at + c * frame.pixels;
    x[i] = select(0.0, clamp(start_of(c, at), 0.0, 1.0), majoriser[i] > 0.0);
  }
}
