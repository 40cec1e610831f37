// What the kernels over a projector's pixels share.
struct Frame {
  columns: u32,
  rows: u32,
  pixels: u32,
  // where this projector's partial sums begin
  partials: u32,
  strength_per_step: f32,
  // share of white that only greys get
  segment: f32,
  // light under a pixel up to which it counts as in shadow
  faint: f32,
  // rows: camera channel by projector channel, or its inverse
  matrix: array<vec4<f32>, 3>,
}

@group(0) @binding(0) var<uniform> frame: Frame;

fn index_of(id: vec3<u32>, groups: vec3<u32>) -> u32 { return id.x + id.y * groups.x * 64u; }

fn applied(p: vec3<f32>) -> vec3<f32> {
  return vec3<f32>(dot(frame.matrix[0].xyz, p), dot(frame.matrix[1].xyz, p), dot(frame.matrix[2].xyz, p));
}
