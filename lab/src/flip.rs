//! Images rotated by right angles or mirrored, the camera that would see them, and objects in its frame. An ideal detector has no
//! preferred direction: it finds the same objects however a frame is turned.

use conicflow_messages::{Camera, HAS_POSE, Header, Object, ObjectSigma};
use nalgebra::{Matrix3, Vector3};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The rotation or mirroring of an image.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Flip {
    /// Unchanged.
    #[default]
    None,
    /// A quarter turn: the left side becomes the top.
    Clockwise,
    /// A quarter turn: the top becomes the left side.
    Counterclockwise,
    /// A half turn.
    UpsideDown,
    /// Left and right are exchanged.
    Horizontal,
    /// Top and bottom are exchanged.
    Vertical,
}

impl Flip {
    /// Returns for the new axes x and y the old axis (0 or 1), and whether both point the same way.
    fn axes(self) -> [(usize, bool); 2] {
        match self {
            Self::None => [(0, true), (1, true)],
            Self::Clockwise => [(1, false), (0, true)],
            Self::Counterclockwise => [(1, true), (0, false)],
            Self::UpsideDown => [(0, false), (1, false)],
            Self::Horizontal => [(0, false), (1, true)],
            Self::Vertical => [(0, true), (1, false)],
        }
    }

    /// Returns the matrix from the camera's frame to the flipped camera's frame.
    fn matrix(self) -> Matrix3<f64> {
        let mut matrix = Matrix3::zeros();
        for (row, (column, same)) in self.axes().into_iter().enumerate() {
            matrix[(row, column)] = if same { 1.0 } else { -1.0 };
        }
        matrix[(2, 2)] = 1.0;
        matrix
    }

    /// Returns the camera that sees the flipped image.
    pub fn camera(self, camera: &Camera) -> Camera {
        let (sizes, focal, center) = ([camera.width, camera.height], [camera.fx, camera.fy], [camera.cx, camera.cy]);
        let [x, y] = self.axes().map(|(axis, same)| {
            let last = f64::from(sizes[axis]) - 1.0;
            (sizes[axis], focal[axis], if same { center[axis] } else { last - center[axis] })
        });
        Camera { width: x.0, height: y.0, fx: x.1, fy: y.1, cx: x.2, cy: y.2 }
    }

    /// Returns the header of the flipped frame. A mirrored frame loses its pose, since a pose is a rotation.
    pub fn header(self, header: &Header) -> Header {
        let mut flipped = Header { camera: self.camera(&header.camera), ..*header };
        let matrix = self.matrix();
        if matrix.determinant() < 0.0 {
            flipped.flags &= !HAS_POSE;
            flipped.world_from_camera = Header::default().world_from_camera;
        } else if let Some(rows) = header.pose() {
            for (row, new) in rows.iter().zip(&mut flipped.world_from_camera) {
                let rotated = matrix * Vector3::new(row[0], row[1], row[2]);
                *new = [rotated.x, rotated.y, rotated.z, row[3]];
            }
        }
        flipped
    }

    /// Writes the flipped image of a camera; both images are stored row by row.
    ///
    /// # Panics
    /// An image does not have as many pixels as the camera.
    pub fn image(self, camera: &Camera, pixels: &[u16], flipped: &mut [u16]) {
        let sizes = [camera.width as usize, camera.height as usize];
        assert_eq!([pixels.len(), flipped.len()], [sizes[0] * sizes[1]; 2]);
        // The old index of a pixel changes by one constant step along a row, and by another from row to row.
        let old_strides = [1, sizes[0]];
        let axes = self.axes();
        let corner: usize =
            axes.iter().filter(|(_, same)| !same).map(|&(axis, _)| old_strides[axis] * (sizes[axis] - 1)).sum();
        let from = |start: usize, (axis, same): (usize, bool), count: usize| {
            let offset = old_strides[axis] * count;
            if same { start + offset } else { start - offset }
        };
        for (y, row) in flipped.chunks_exact_mut(sizes[axes[0].0]).enumerate() {
            let start = from(corner, axes[1], y);
            for (x, pixel) in row.iter_mut().enumerate() {
                *pixel = pixels[from(start, axes[0], x)];
            }
        }
    }

    /// Returns the object in the frame of the flipped camera.
    pub fn object(self, object: &Object) -> Object {
        let matrix = self.matrix();
        let turned = |vector: [f64; 3]| (matrix * Vector3::from(vector)).into();
        let covariance = Matrix3::from_fn(|row, column| object.sigma.center[row][column]);
        let covariance = matrix * covariance * matrix.transpose();
        let sigma = ObjectSigma {
            center: [0, 1, 2].map(|row| [0, 1, 2].map(|column| covariance[(row, column)])),
            ..object.sigma
        };
        let [center, axis, apex] = [object.center, object.axis, object.apex].map(turned);
        Object { center, axis, apex, sigma, ..*object }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ALL: [Flip; 6] =
        [Flip::None, Flip::Clockwise, Flip::Counterclockwise, Flip::UpsideDown, Flip::Horizontal, Flip::Vertical];

    fn back(flip: Flip) -> Flip {
        match flip {
            Flip::Clockwise => Flip::Counterclockwise,
            Flip::Counterclockwise => Flip::Clockwise,
            other => other,
        }
    }

    fn camera() -> Camera {
        Camera { width: 3, height: 2, fx: 5.0, fy: 6.0, cx: 0.75, cy: 0.5 }
    }

    #[test]
    fn images_are_turned_and_mirrored() {
        let pixels = [1, 2, 3, 4, 5, 6];
        for (flip, width, expected) in [
            (Flip::None, 3, [1, 2, 3, 4, 5, 6]),
            (Flip::Clockwise, 2, [4, 1, 5, 2, 6, 3]),
            (Flip::Counterclockwise, 2, [3, 6, 2, 5, 1, 4]),
            (Flip::UpsideDown, 3, [6, 5, 4, 3, 2, 1]),
            (Flip::Horizontal, 3, [3, 2, 1, 6, 5, 4]),
            (Flip::Vertical, 3, [4, 5, 6, 1, 2, 3]),
        ] {
            let mut flipped = [0; 6];
            flip.image(&camera(), &pixels, &mut flipped);
            let new = flip.camera(&camera());
            assert_eq!((flipped, [new.width, new.height]), (expected, [width, 6 / width]), "{flip:?}");
        }
    }

    /// The pixel that shows a point shows it in the flipped image, too.
    #[test]
    fn a_point_stays_on_its_pixel() {
        let (camera, depth) = (camera(), 2.0);
        for flip in ALL {
            let new = flip.camera(&camera);
            for index in 0..6 {
                let mut pixels = [0; 6];
                pixels[index] = 1;
                let mut flipped = [0; 6];
                flip.image(&camera, &pixels, &mut flipped);
                let there = flipped.iter().position(|&pixel| pixel == 1).unwrap();
                let point = |camera: &Camera, index: usize| {
                    let (u, v) = ((index % camera.width as usize) as f64, (index / camera.width as usize) as f64);
                    [(u - camera.cx) / camera.fx * depth, (v - camera.cy) / camera.fy * depth, depth]
                };
                let object = flip.object(&Object { center: point(&camera, index), ..Object::default() });
                let error = Vector3::from(object.center) - Vector3::from(point(&new, there));
                assert!(error.norm() < 1e-12, "{flip:?} of pixel {index}: {error}");
            }
        }
    }

    #[test]
    fn what_is_flipped_and_flipped_back_is_what_it_was() {
        let world_from_camera = [[0.0, -1.0, 0.0, 1.0], [1.0, 0.0, 0.0, 2.0], [0.0, 0.0, 1.0, 3.0]];
        let header = Header { camera: camera(), flags: HAS_POSE, world_from_camera, ..Header::default() };
        let sigma =
            ObjectSigma { center: [[1.0, 0.2, 0.3], [0.2, 2.0, 0.4], [0.3, 0.4, 3.0]], ..ObjectSigma::default() };
        let (center, axis, apex) = ([0.1, 0.2, 1.0], [0.6, 0.0, 0.8], [0.3, -0.4, 2.0]);
        let object = Object { center, axis, apex, sigma, radius: 0.1, ..Object::default() };
        for flip in ALL {
            let (flipped, there) = (flip.header(&header), flip.object(&object));
            assert_eq!(back(flip).object(&there), object, "{flip:?}");
            assert_eq!(back(flip).camera(&flipped.camera), header.camera, "{flip:?}");
            let Some(pose) = flipped.pose() else {
                assert!(matches!(flip, Flip::Horizontal | Flip::Vertical));
                continue;
            };
            let in_world = |pose: &[[f64; 4]; 3], [x, y, z]: [f64; 3]| {
                pose.map(|row| row[0] * x + row[1] * y + row[2] * z + row[3])
            };
            let [before, after] = [in_world(&header.world_from_camera, center), in_world(pose, there.center)];
            assert!((Vector3::from(before) - Vector3::from(after)).norm() < 1e-12, "{flip:?}");
        }
        let quarter = Flip::Clockwise.object(&object);
        assert_eq!((quarter.center, quarter.axis), ([-0.2, 0.1, 1.0], [-0.0, 0.6, 0.8]));
        assert_eq!(quarter.sigma.center, [[2.0, -0.2, -0.4], [-0.2, 1.0, 0.3], [-0.4, 0.3, 3.0]]);
    }
}
