// Writes what each projector should show in a block, as in bounded/initial_estimate.py: three unknowns y, and
// p = start - B' y within bounds. Light is in units of all projectors' light there.
@group(0) @binding(1) var<storage, read> white: array<f32>;
@group(0) @binding(2) var<storage, read> wanted: array<f32>;
@group(0) @binding(3) var<storage, read> mixing: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> shown: array<f32>;

// What projector n adds to the light: camera channel by projector channel, columns as WGSL has them.
fn light_of(n: u32, at: u32, unit: f32) -> mat3x3<f32> {
  let count = blocks.across * blocks.down;
  let light = vec3<f32>(
    white[3u * n * count + at], white[(3u * n + 1u) * count + at], white[(3u * n + 2u) * count + at]
  ) * unit;
  let rows = transpose(mat3x3<f32>(mixing[3u * n].xyz, mixing[3u * n + 1u].xyz, mixing[3u * n + 2u].xyz));
  return mat3x3<f32>(light * rows[0], light * rows[1], light * rows[2]);
}

// y and light less B p, and what Newton's method needs of the numbers that are off their bounds.
fn gradient_at(y: vec3<f32>, light: vec3<f32>, start: vec3<f32>, at: u32, unit: f32) -> vec3<f32> {
  var found = RIDGE * y + light;
  for (var n = 0u; n < blocks.projectors; n++) {
    let B = light_of(n, at, unit);
    found -= B * clamp(start - transpose(B) * y, vec3<f32>(0.0), vec3<f32>(1.0));
  }
  return found;
}

fn newton_step(y: vec3<f32>, gradient: vec3<f32>, start: vec3<f32>, at: u32, unit: f32) -> vec3<f32> {
  var a = RIDGE; var b = 0.0; var c = 0.0;
  var d = RIDGE; var e = 0.0; var f = RIDGE;
  for (var n = 0u; n < blocks.projectors; n++) {
    let B = light_of(n, at, unit);
    let p = start - transpose(B) * y;
    for (var k = 0u; k < 3u; k++) {
      if (p[k] > 0.0 && p[k] < 1.0) {
        let u = B[k];
        a += u.x * u.x; b += u.x * u.y; c += u.x * u.z;
        d += u.y * u.y; e += u.y * u.z; f += u.z * u.z;
      }
    }
  }
  // Cholesky's factors; rounding must not make a root of a negative number
  let g = sqrt(a);
  let h = b / g;
  let i = c / g;
  let j = sqrt(max(d - h * h, 0.1 * RIDGE));
  let k = (e - h * i) / j;
  let m = sqrt(max(f - i * i - k * k, 0.1 * RIDGE));
  let r = -gradient.x / g;
  let s = (-gradient.y - h * r) / j;
  let t = (-gradient.z - i * r - k * s) / m;
  let z = t / m;
  let w = (s - k * z) / j;
  return vec3<f32>((r - h * w - i * z) / g, w, z);
}

fn within(p: vec3<f32>) -> bool { return min(p.x, min(p.y, p.z)) >= 0.0 && max(p.x, max(p.y, p.z)) <= 1.0; }

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
  let at = index_of(id, groups);
  let count = blocks.across * blocks.down;
  if (at >= count) { return; }
  var all = mat3x3<f32>();
  for (var n = 0u; n < blocks.projectors; n++) { all += light_of(n, at, 1.0); }
  let size = sqrt((all[0].x * all[0].x + all[1].y * all[1].y + all[2].z * all[2].z) / 3.0);
  let unit = 1.0 / max(size, 1e-30);
  all *= unit;
  let light = vec3<f32>(wanted[at], wanted[count + at], wanted[2u * count + at]) * unit;
  let area = determinant(all);
  var p = vec3<f32>(light.x / max(all[0].x, 1e-30), light.y / max(all[1].y, 1e-30), light.z / max(all[2].z, 1e-30));
  if (area > LEAST_DETERMINANT) {
    p = vec3<f32>(
      determinant(mat3x3<f32>(light, all[1], all[2])),
      determinant(mat3x3<f32>(all[0], light, all[2])),
      determinant(mat3x3<f32>(all[0], all[1], light))
    ) / area;
  }
  let start = clamp(p, vec3<f32>(0.0), vec3<f32>(1.0));
  var y = vec3<f32>(0.0);
  if (size > 0.0 && !within(p)) {
    var gradient = gradient_at(y, light, start, at, unit);
    for (var k = 0; k < MOST_STEPS; k++) {
      if (max(abs(gradient.x), max(abs(gradient.y), abs(gradient.z))) < SINGLE_CLOSE) { break; }
      let step = newton_step(y, gradient, start, at, unit);
      let slope = dot(gradient, step);
      if (!(slope < 0.0)) { break; }
      var length = 1.0;
      var ahead = y + step;
      gradient = gradient_at(ahead, light, start, at, unit);
      for (var half = 0; half < SINGLE_MOST_HALVINGS && dot(gradient, step) > -LEVEL * slope; half++) {
        length *= 0.5;
        ahead = y + length * step;
        gradient = gradient_at(ahead, light, start, at, unit);
      }
      y = ahead;
    }
  }
  for (var n = 0u; n < blocks.projectors; n++) {
    let found = clamp(start - transpose(light_of(n, at, unit)) * y, vec3<f32>(0.0), vec3<f32>(1.0));
    for (var c = 0u; c < 3u; c++) { shown[(3u * n + c) * count + at] = found[c]; }
  }
}
