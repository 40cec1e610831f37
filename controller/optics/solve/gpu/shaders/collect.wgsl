// Writes D' r: a picture's values back to the sites it was interpolated from.
@group(0) @binding(1) var<storage, read> picture: array<f32>;
@group(0) @binding(2) var<storage, read_write> sites: array<f32>;

// Of how many sites the mean is that a pixel has in a colour not its own.
fn neighbours(y: i32, x: i32, colour: u32) -> f32 {
  if (y > 0 && x > 0 && y < camera.rows - 1 && x < camera.columns - 1) {
    return select(4.0, 2.0, colour_at(y, x) == GREEN);
  }
  var count = 0.0;
  for (var r = max(y - 1, 0); r < min(y + 2, camera.rows); r++) {
    for (var c = max(x - 1, 0); c < min(x + 2, camera.columns); c++) {
      count += select(0.0, 1.0, colour_at(r, c) == colour);
    }
  }
  return count;
}

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
  let at = index_of(id, groups);
  if (at >= camera.pixels) { return; }
  let y = i32(at) / camera.columns;
  let x = i32(at) % camera.columns;
  let own = colour_at(y, x);
  let plane = i32(own * camera.pixels);
  var total = picture[plane + i32(at)];
  for (var r = max(y - 1, 0); r < min(y + 2, camera.rows); r++) {
    for (var c = max(x - 1, 0); c < min(x + 2, camera.columns); c++) {
      if (colour_at(r, c) != own) {
        total += picture[plane + r * camera.columns + c] / neighbours(r, c, own);
      }
    }
  }
  sites[at] = total;
}
