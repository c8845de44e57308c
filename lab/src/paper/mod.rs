//! The method of Georgiev, Al-Hami and Lakaemper, "Real-time 3D scene description using spheres, cones and cylinders"
//! (2013), as the baseline: Algorithm 1 with its pre-filter in [`extractor`], objects section by section in [`assembler`].

pub mod assembler;
pub mod extractor;
