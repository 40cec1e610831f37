// What the kernels over the camera's pixels share.
struct Camera {
  rows: i32,
  columns: i32,
  pixels: u32,
  unused: u32,
  // of sites at even and odd rows and columns, row by row
  colours: vec4<u32>,
}

@group(0) @binding(0) var<uniform> camera: Camera;

fn index_of(id: vec3<u32>, groups: vec3<u32>) -> u32 { return id.x + id.y * groups.x * 64u; }
fn colour_at(y: i32, x: i32) -> u32 { return camera.colours[2 * (y & 1) + (x & 1)]; }
