// A projector's term at depth edges: differences of shares, by camera pixel (rows) and projector pixel.
struct Term {
  rows: u32,
  // projector pixels that have differences
  columns: u32,
  pixels: u32,
  camera_pixels: u32,
  sites: u32,
  edges: u32,
  mixing: array<vec4<f32>, 3>,
}

@group(0) @binding(0) var<uniform> term: Term;
@group(0) @binding(1) var<storage, read> first: array<u32>;
@group(0) @binding(2) var<storage, read> members: array<u32>;
@group(0) @binding(3) var<storage, read> differences: array<f32>;
@group(0) @binding(4) var<storage, read> white: array<f32>;

fn index_of(id: vec3<u32>, groups: vec3<u32>) -> u32 { return id.x + id.y * groups.x * 64u; }
