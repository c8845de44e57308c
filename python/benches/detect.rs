//! The reference for `benches/detect.py`: the time of the detector in Rust on the same frames, in milliseconds.
//!
//! Arguments: a file of raw 16-bit pixels, width, height, fx, fy, cx, cy, and the number of rounds.

use conicflow_detection::{Camera, Detector};
use std::error::Error;
use std::time::Instant;

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().collect();
    let [_, path, width, height, fx, fy, cx, cy, rounds] = &arguments[..] else { return Err("eight arguments".into()) };
    let pixels: Vec<u16> = std::fs::read(path)?.as_chunks().0.iter().map(|pixel| u16::from_le_bytes(*pixel)).collect();
    let (width, height) = (width.parse()?, height.parse()?);
    let camera = Camera { width, height, fx: fx.parse()?, fy: fy.parse()?, cx: cx.parse()?, cy: cy.parse()? };
    let mut detector = Detector::new(camera);
    for _ in 0..rounds.parse()? {
        for frame in pixels.chunks_exact(width as usize * height as usize) {
            let start = Instant::now();
            let objects = detector.detect(frame);
            println!("{:.6} {}", start.elapsed().as_secs_f64() * 1e3, objects.len());
        }
    }
    Ok(())
}
