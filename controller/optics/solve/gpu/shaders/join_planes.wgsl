// Makes an image by pixel of three planes.
@group(0) @binding(1) var<storage, read> planes: array<f32>;
@group(0) @binding(2) var<storage, read_write> image: array<f32>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
  let at = index_of(id, groups);
  if (at >= frame.pixels) { return; }
  for (var c = 0u; c < 3u; c++) { image[3u * at + c] = planes[at + c * frame.pixels]; }
}
