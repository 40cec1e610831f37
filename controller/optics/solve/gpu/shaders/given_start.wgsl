// A frame that was given, an image by pixel.
@group(0) @binding(3) var<storage, read> image: array<f32>;

fn start_of(c: u32, at: u32) -> f32 { return image[3u * at + c]; }
