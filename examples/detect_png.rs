//! Finds the objects of a depth image in millimetres: `cargo run --example detect_png -- depth.png`
use conicflow_detection::{Camera, Detector, NoiseModel};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let file = std::fs::File::open(std::env::args().nth(1).ok_or("which 16-bit PNG?")?)?;
    let mut reader = png::Decoder::new(std::io::BufReader::new(file)).read_info()?;
    let mut bytes = vec![0; reader.output_buffer_size().ok_or("too large an image")?];
    let png::OutputInfo { width, height, .. } = reader.next_frame(&mut bytes)?;
    let depth: Vec<u16> = bytes.chunks_exact(2).map(|pixel| u16::from_be_bytes([pixel[0], pixel[1]])).collect();
    let camera = Camera { width, height, fx: 525.0, fy: 525.0, cx: 319.5, cy: 239.5 };
    for object in Detector::new(camera).noise(NoiseModel::KINECT_V1).depth_scale(0.001).detect(&depth) {
        println!("{} at {:.3?} m, radius {:.4} m", object.shape().name(), object.center, object.radius);
    }
    Ok(())
}
