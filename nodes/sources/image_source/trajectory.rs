//! Readers of camera trajectories in the three formats that recordings come with. Each pose is `world_from_camera`, in metres, of
//! a camera that looks along z with x to the right and y down.
//!
//! - a 4x4 matrix, row by row: 7-Scenes (`frame-000012.pose.txt`)
//!   <https://www.microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes/>;
//! - a line `timestamp tx ty tz qx qy qz qw` for each pose: TUM RGB-D (`groundtruth.txt`)
//!   <https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats>;
//! - three whole numbers and a 4x4 matrix for each frame: Open3D's and Redwood's `.log`
//!   <http://redwood-data.org/indoor/fileformat.html>.
//!
//! A matrix with a number that is not finite means that the camera was lost at that frame.

use super::faulty::excerpt;
use super::tum;
use anyhow::{Context as _, Result, bail, ensure};
use conicflow_messages::is_rotation;
use nalgebra::{Isometry3, Matrix3, Quaternion, Rotation3, Translation3, UnitQuaternion};

/// Largest deviation of a quaternion's length from 1; rounding to four digits, as in TUM's files, stays within it.
const UNIT_TOLERANCE: f64 = 1e-2;

/// Hint of the errors: the expected format of a file of poses.
pub(super) const HINT: &str = "a pose is a 4x4 matrix `world_from_camera` (7-Scenes `*.pose.txt`), a line `timestamp tx ty tz qx \
                               qy qz qw` (TUM `groundtruth.txt`), or three whole numbers and such a matrix (Open3D `.log`); \
                               `poses = \"none\"`, of `conicflow detect` `--poses none`, leaves them alone";

/// A pose; `None` where the camera was lost.
pub(super) type Known = Option<Isometry3<f64>>;

/// The content of a file.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Trajectory {
    /// One pose.
    Single(Known),
    /// A pose for each frame, in their order.
    InOrder(Vec<Known>),
    /// Poses by their times in nanoseconds, ascending.
    Timed(Vec<(u64, Isometry3<f64>)>),
}

/// A line that is neither empty nor a comment, with its number.
type Line<'a> = (usize, &'a str);

/// Whether a text begins as an Open3D trajectory does: with three whole numbers.
pub(super) fn begins_in_order(text: &str) -> bool {
    tum::lines(text).next().is_some_and(|(_, line)| frame_numbers(line).is_some())
}

/// Reads a file of any of the formats; the number of words in the first line decides which one it is.
///
/// # Errors
/// Says which line is wrong, and why.
pub(super) fn parse(text: &str) -> Result<Trajectory> {
    let lines: Vec<Line> = tum::lines(text).collect();
    let (number, first) = *lines.first().context("there is nothing in it")?;
    match first.split_whitespace().count() {
        3 => in_order(&lines).map(Trajectory::InOrder),
        4 => {
            let after = lines.get(4).map(|(number, line)| format!(": line {number}, `{}`", excerpt(line)));
            ensure!(after.is_none(), "it goes on after four lines of a matrix{}", after.unwrap_or_default());
            matrix(&lines, number).map(Trajectory::Single)
        }
        8 => timed(&lines).map(Trajectory::Timed),
        count => bail!("line {number}, `{}`: {count} words, expected 3, 4 or 8 numbers", excerpt(first)),
    }
}

/// Returns the numbers of a line that holds exactly `N` of them. They may be infinite or NaN, where the camera was lost.
fn numbers<const N: usize>((number, line): Line) -> Result<[f64; N]> {
    let words: Vec<&str> = line.split_whitespace().collect();
    let parsed: Option<Vec<f64>> = words.iter().map(|word| parsed(word)).collect();
    let expected = || format!("line {number}, `{}`: expected {N} numbers", excerpt(line));
    parsed.and_then(|numbers| numbers.try_into().ok()).with_context(expected)
}

/// Reads a number; `-1.#IND` and the like, which C writes on Windows, are NaN.
fn parsed(word: &str) -> Option<f64> {
    if word.contains(".#") { Some(f64::NAN) } else { word.parse().ok() }
}

fn frame_numbers(line: &str) -> Option<[i64; 3]> {
    let numbers: Option<Vec<i64>> = line.split_whitespace().map(|word| word.parse().ok()).collect();
    numbers?.try_into().ok()
}

/// Reads blocks of three whole numbers and a matrix; the numbers are ignored, as the order of the blocks says the same.
fn in_order(lines: &[Line]) -> Result<Vec<Known>> {
    let block = |block: &[Line]| {
        let (number, head) = block[0];
        let expected = || format!("line {number}, `{}`: expected three whole numbers before a matrix", excerpt(head));
        frame_numbers(head).with_context(expected)?;
        matrix(&block[1..], number)
    };
    lines.chunks(5).map(block).collect()
}

/// Reads a matrix of four lines; `number` is that of its first line, for the error where lines are missing.
fn matrix(lines: &[Line], number: usize) -> Result<Known> {
    ensure!(lines.len() >= 4, "the matrix from line {number} on has {} lines, expected 4", lines.len());
    let mut rows = [[0.0; 4]; 4];
    for (row, line) in rows.iter_mut().zip(lines) {
        *row = numbers(*line)?;
    }
    let [x, y, z, last] = rows;
    if !rows.iter().flatten().all(|number| number.is_finite()) {
        return Ok(None);
    }
    ensure!(
        last == [0.0, 0.0, 0.0, 1.0],
        "line {}, `{}`: expected `0 0 0 1`, the last row of a pose",
        lines[3].0,
        excerpt(lines[3].1)
    );
    let rows = [x, y, z];
    ensure!(
        is_rotation(&rows),
        "the matrix from line {} on is no pose: its left 3x3 part is no rotation (rows of length 1, perpendicular, \
         right-handed)",
        lines[0].0
    );
    let rotation = Rotation3::from_matrix_unchecked(Matrix3::from_fn(|row, column| rows[row][column]));
    let translation = Translation3::new(x[3], y[3], z[3]);
    Ok(Some(Isometry3::from_parts(translation, UnitQuaternion::from_rotation_matrix(&rotation))))
}

fn timed(lines: &[Line]) -> Result<Vec<(u64, Isometry3<f64>)>> {
    let mut poses: Vec<_> = lines.iter().map(|line| timed_pose(*line)).collect::<Result<_>>()?;
    poses.sort_by_key(|(stamp_ns, _)| *stamp_ns);
    Ok(poses)
}

fn timed_pose((number, line): Line) -> Result<(u64, Isometry3<f64>)> {
    let [_, tx, ty, tz, qx, qy, qz, qw] = numbers((number, line))?;
    let fault = |what: &str| format!("line {number}, `{}`: {what}", excerpt(line));
    let stamp = line.split_whitespace().next().and_then(tum::nanoseconds);
    let stamp_ns = stamp.with_context(|| fault("it does not begin with a time in seconds"))?;
    ensure!([tx, ty, tz].iter().all(|number| number.is_finite()), fault("a place that is not finite"));
    let quaternion = Quaternion::new(qw, qx, qy, qz);
    let length = quaternion.norm();
    ensure!(
        (length - 1.0).abs() <= UNIT_TOLERANCE,
        fault(&format!("a quaternion `qx qy qz qw` of length {length:.3}, expected 1"))
    );
    Ok((stamp_ns, Isometry3::from_parts(Translation3::new(tx, ty, tz), UnitQuaternion::from_quaternion(quaternion))))
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Point3, Vector3};

    /// Looks along the world's x, with the world's z upwards, from (1, 2, 3).
    const MATRIX: &str = "0 0 1 1\n-1 0 0 2\n0 -1 0 3\n0 0 0 1\n";

    fn seen(pose: &Isometry3<f64>) -> [f64; 3] {
        (pose * Point3::new(0.1, 0.2, 1.0)).coords.into()
    }

    fn assert_looks_along_x(pose: &Isometry3<f64>) {
        let offset = Vector3::from(seen(pose)) - Vector3::new(2.0, 1.9, 2.8);
        assert!(offset.norm() < 1e-6, "{pose}");
    }

    fn error_of(text: &str) -> String {
        format!("{:#}", parse(text).unwrap_err())
    }

    #[test]
    fn a_matrix_maps_the_camera_to_the_world() {
        let Ok(Trajectory::Single(Some(pose))) = parse(MATRIX) else { panic!() };
        assert_looks_along_x(&pose);
        let tabs = MATRIX.replace(' ', "\t ").replace('\n', " \r\n") + "\r\n";
        assert_eq!(parse(&tabs).unwrap(), Trajectory::Single(Some(pose)), "7-Scenes has tabs and CRLF");
    }

    #[test]
    fn a_camera_that_was_lost_has_no_pose() {
        for lost in ["nan", "-inf", "-1.#IND000", "1.#QNAN"] {
            assert_eq!(parse(&MATRIX.replace("-1", lost)).unwrap(), Trajectory::Single(None), "{lost}");
        }
    }

    #[test]
    fn a_quaternion_maps_the_camera_to_the_world() {
        let text = "# ground truth trajectory\n# timestamp tx ty tz qx qy qz qw\n7.5 4 5 6 0 0 0 1\n\
                    1305031098.6659 1 2 3 -0.5 0.5 -0.5 0.5\n";
        let Ok(Trajectory::Timed(poses)) = parse(text) else { panic!() };
        assert_eq!(
            poses.iter().map(|(stamp, _)| *stamp).collect::<Vec<_>>(),
            [7_500_000_000, 1_305_031_098_665_900_000]
        );
        assert_looks_along_x(&poses[1].1);
        assert_eq!(seen(&poses[0].1), [4.1, 5.2, 7.0]);
    }

    #[test]
    fn blocks_are_in_the_order_of_the_frames() {
        let text =
            format!("0 0 1\n1 0 0 4\n0 1 0 5\n0 0 1 6\n0 0 0 1\n1 1 2\n{MATRIX}2 2 3\n{}", MATRIX.replace('3', "nan"));
        assert!(begins_in_order(&text) && !begins_in_order(MATRIX) && !begins_in_order("a log of mine\n"));
        let Ok(Trajectory::InOrder(poses)) = parse(&text) else { panic!() };
        assert_eq!((poses.len(), seen(&poses[0].unwrap())), (3, [4.1, 5.2, 7.0]));
        assert_looks_along_x(&poses[1].unwrap());
        assert_eq!(poses[2], None);
    }

    #[test]
    fn faults_are_reported_with_their_line() {
        assert_eq!(error_of("\n# nothing\n"), "there is nothing in it");
        assert_eq!(error_of("one line\n"), "line 1, `one line`: 2 words, expected 3, 4 or 8 numbers");
        assert_eq!(error_of("1 0 0 0\n0 1 0 0\n"), "the matrix from line 1 on has 2 lines, expected 4");
        assert_eq!(error_of(&MATRIX.replace("-1 0 0 2", "-1 0 0")), "line 2, `-1 0 0`: expected 4 numbers");
        assert_eq!(error_of(&MATRIX.replace("-1 0 0 2", "-1 0 o 2")), "line 2, `-1 0 o 2`: expected 4 numbers");
        let last = error_of(&MATRIX.replace("0 0 0 1", "1 2 3 1"));
        assert_eq!(last, "line 4, `1 2 3 1`: expected `0 0 0 1`, the last row of a pose");
        for no_rotation in
            [MATRIX.replacen("-1", "1", 1), MATRIX.replace("-1", "-2"), MATRIX.replace("-1 0 0", "-1 0.1 0")]
        {
            assert!(error_of(&no_rotation).contains("from line 1 on is no pose: "), "{no_rotation}");
        }
        assert!(
            error_of(&format!("{MATRIX}1 2 3 4\n")).starts_with("it goes on after four lines of a matrix: line 5, ")
        );
        let cut = format!("0 0 1\n{MATRIX}1 1 2\n1 0 0 0\n");
        assert_eq!(error_of(&cut), "the matrix from line 6 on has 1 lines, expected 4");
        let shifted = format!("0 0 1\n{MATRIX}{MATRIX}0 0 0 0\n");
        assert_eq!(error_of(&shifted), "line 6, `0 0 1 1`: expected three whole numbers before a matrix");
        assert_eq!(error_of("1 2 3 4 5 6 7 eight\n"), "line 1, `1 2 3 4 5 6 7 eight`: expected 8 numbers");
        assert!(error_of("-1 0 0 0 0 0 0 1\n").ends_with("it does not begin with a time in seconds"));
        assert!(error_of("1 0 inf 0 0 0 0 1\n").ends_with("a place that is not finite"));
        let scalar_first = "5.0 0 0 0 0.9 0.9 0 0\n";
        assert!(error_of(scalar_first).ends_with("a quaternion `qx qy qz qw` of length 1.273, expected 1"));
    }
}
