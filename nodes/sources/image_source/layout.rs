//! Finds the depth frames of a path and their order: single files, folders of PNG, TIFF, NPY or PCD, TUM RGB-D folders.
//!
//! The header of every file is read before the first frame is sent. So other files are skipped, unreadable ones are known, and
//! the number of frames and their size are certain.

use super::faulty::hinted;
use super::{depth_png, pcd, raster, tum};
use anyhow::{Context as _, Error, Result, anyhow, bail};
use conicflow_messages::{Hinted, read_text};
use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::Read as _;
use std::path::{Path, PathBuf};

const PCD_HEADER_BYTES: u64 = 64 * 1024;

/// The file format of the frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Format {
    /// 16-bit grey PNG.
    Png,
    /// TIFF of one channel, 16-bit or floating point.
    Tiff,
    /// NumPy array, 16-bit or floating point.
    Npy,
    /// Organised point cloud.
    Pcd,
}

impl Format {
    /// Names several files of this format for errors.
    fn files(self) -> &'static str {
        match self {
            Self::Png => "16-bit PNGs",
            Self::Tiff => "TIFF files",
            Self::Npy => "NPY files",
            Self::Pcd => "PCD files",
        }
    }

    /// Hint of the errors about unreadable files.
    pub(super) fn hint(self) -> &'static str {
        match self {
            Self::Png => depth_png::HINT,
            Self::Tiff => raster::TIFF_HINT,
            Self::Npy => raster::NPY_HINT,
            Self::Pcd => pcd::HINT,
        }
    }

    /// Usual metres per unit of whole numbers; points are in metres.
    fn depth_scale(self) -> f64 {
        if self == Self::Pcd { 1.0 } else { 0.001 }
    }

    /// Reads width and height of a frame from the header of its file.
    fn size(self, path: &Path) -> Result<(u32, u32)> {
        let size = match self {
            Self::Png => depth_png::probe(path).and_then(depth_png::Content::depth_size),
            Self::Tiff => File::open(path).map_err(Error::from).and_then(raster::tiff_size),
            Self::Npy => File::open(path).map_err(Error::from).and_then(raster::npy_size),
            Self::Pcd => pcd_size(path),
        };
        size.map_err(|error| hinted(error, self.hint()))
    }

    fn candidate(self, path: PathBuf) -> Candidate {
        Candidate { size: self.size(&path), path, stamp_ns: None }
    }
}

/// Callback for progress: the number of files seen, and of all files as far as that is known. A folder may have so many files
/// that reading their headers takes minutes, and listing them a second.
pub(super) type Progress<'a> = dyn FnMut(usize, usize) + 'a;

/// One depth frame.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct FrameFile {
    pub(super) path: PathBuf,
    /// Width and height.
    pub(super) size: (u32, u32),
    /// Position in the recording, counting unreadable frames.
    pub(super) slot: u64,
    /// Time of capture, if the recording has it.
    pub(super) stamp_ns: Option<u64>,
}

/// The frames of a path.
#[derive(Debug)]
pub(super) struct Layout {
    pub(super) format: Format,
    /// The folder of the frames.
    pub(super) folder: PathBuf,
    /// Usual metres per unit of this layout.
    pub(super) depth_scale: f64,
    /// In the order in which they are sent; at least one.
    pub(super) frames: Vec<FrameFile>,
    /// Positions of the unreadable frames, and their errors.
    pub(super) unreadable: Vec<(u64, Error)>,
}

impl Layout {
    /// Finds the frames of `path`, a file or a folder; reports its progress.
    ///
    /// # Errors
    /// There is nothing at `path`, or no readable frame.
    pub(super) fn discover(path: &Path, progress: &mut Progress<'_>) -> Result<Self> {
        let path = fs::canonicalize(path).map_err(|error| {
            let what = format!("`{}` cannot be opened: {error}", path.display());
            Hinted::new(what, "relative paths start at the pipeline file's folder")
        })?;
        let layout = if path.is_file() { single_file(&path, progress) } else { folder(&path, progress) };
        layout?.readable(&path)
    }

    fn new(format: Format, folder: &Path, depth_scale: f64, candidates: Vec<Candidate>) -> Self {
        let mut layout = Self { format, folder: folder.to_owned(), depth_scale, frames: vec![], unreadable: vec![] };
        for (slot, candidate) in (0..).zip(candidates) {
            let Candidate { path, size, stamp_ns } = candidate;
            match size {
                Ok(size) => layout.frames.push(FrameFile { path, size, slot, stamp_ns }),
                Err(error) => layout.unreadable.push((slot, error.context(format!("`{}`", path.display())))),
            }
        }
        layout
    }

    fn readable(mut self, path: &Path) -> Result<Self> {
        if !self.frames.is_empty() || self.unreadable.is_empty() {
            return Ok(self);
        }
        let count = self.unreadable.len();
        let (_, first) = self.unreadable.remove(0);
        if path.is_file() {
            return Err(first);
        }
        Err(first.context(format!("none of the {count} frames in `{}` can be read; the first", path.display())))
    }
}

/// Returns width and height of a frame of `path`, reading no more files than needed. All frames have the same size, or else the
/// recording is refused.
pub(super) fn first_size(path: &Path) -> Option<(u32, u32)> {
    let size = |path: &PathBuf| format_of(path)?.size(path).ok();
    if path.is_file() && path.file_name().is_none_or(|name| name != tum::LIST) {
        return size(&path.to_owned());
    }
    let folder = if path.is_dir() { path } else { folder_of(path) };
    for listed in [folder, folder_of(folder)] {
        if let Ok(text) = read_text(&listed.join(tum::LIST), tum::MAX_BYTES) {
            return tum::parse(&text).ok()?.iter().find_map(|entry| size(&listed.join(entry.name)));
        }
    }
    let in_folder = |folder: &Path| {
        let mut files = sorted_files(folder, "", &mut |_, _| ()).ok()?;
        // As in a listing: if some names contain `depth`, the other files are no depth frames.
        files.sort_by_key(|path| !file_name(path).to_lowercase().contains("depth"));
        files.iter().find_map(size)
    };
    in_folder(folder).or_else(|| in_folder(&folder.join("depth")))
}

/// A file that should be a depth frame, and the content of its header.
struct Candidate {
    path: PathBuf,
    size: Result<(u32, u32)>,
    stamp_ns: Option<u64>,
}

fn single_file(path: &Path, progress: &mut Progress<'_>) -> Result<Layout> {
    if path.file_name().is_some_and(|name| name == tum::LIST) {
        return tum_folder(folder_of(path), progress);
    }
    let Some(format) = format_of(path) else {
        bail!(Hinted::new(
            format!("`{}` is no depth frame", path.display()),
            "name a 16-bit PNG, a TIFF, NPY or PCD file, or a folder of them"
        ))
    };
    Ok(Layout::new(format, folder_of(path), format.depth_scale(), vec![format.candidate(path.to_owned())]))
}

fn folder_of(path: &Path) -> &Path {
    path.parent().unwrap_or(Path::new("."))
}

fn folder(path: &Path, progress: &mut Progress<'_>) -> Result<Layout> {
    let above = folder_of(path);
    if path.join(tum::LIST).is_file() {
        return tum_folder(path, progress);
    }
    if path.file_name().is_some_and(|name| name == "depth") && above.join(tum::LIST).is_file() {
        return tum_folder(above, progress);
    }
    let inner = path.join("depth");
    let outer = Listing::read(path, progress)?;
    let listing = if outer.has_frames() || !inner.is_dir() { outer } else { Listing::read(&inner, progress)? };
    listing.into_layout()
}

fn tum_folder(folder: &Path, progress: &mut Progress<'_>) -> Result<Layout> {
    let list = folder.join(tum::LIST);
    let named = |error: Error| hinted(error, tum::HINT).context(format!("`{}`", list.display()));
    let text = read_text(&list, tum::MAX_BYTES).map_err(|error| named(error.into()))?;
    let entries = tum::parse(&text).map_err(named)?;
    let count = entries.len();
    let candidates = (1..).zip(entries).map(|(number, entry)| {
        progress(number, count);
        let path = folder.join(entry.name);
        Candidate { stamp_ns: Some(entry.stamp_ns), ..Format::Png.candidate(path) }
    });
    Ok(Layout::new(Format::Png, folder, tum::DEPTH_SCALE, candidates.collect()))
}

fn pcd_size(path: &Path) -> Result<(u32, u32)> {
    let mut head = Vec::new();
    File::open(path)?.take(PCD_HEADER_BYTES).read_to_end(&mut head)?;
    let header = pcd::Header::parse(&head)?;
    Ok((header.width, header.height))
}

fn format_of(path: &Path) -> Option<Format> {
    match path.extension()?.to_str()?.to_ascii_lowercase().as_str() {
        "png" => Some(Format::Png),
        "tif" | "tiff" => Some(Format::Tiff),
        "npy" => Some(Format::Npy),
        "pcd" => Some(Format::Pcd),
        _ => None,
    }
}

/// Names the kind of a file that has no ending of a depth frame, for errors.
fn other_kind(path: &Path) -> String {
    let Some(ending) = path.extension() else { return "no ending".to_owned() };
    let is_jpeg = ["jpg", "jpeg"].iter().any(|jpeg| ending.eq_ignore_ascii_case(jpeg));
    if is_jpeg { "JPEG".to_owned() } else { format!("`.{}`", ending.to_string_lossy()) }
}

/// Describes the other entries of a folder: folders, of which only `depth` is searched, and links that lead nowhere.
fn other_entries(folder: &Path) -> String {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path());
    let (there, lost): (Vec<_>, Vec<_>) = entries.partition(|path| path.exists());
    let mut folders: Vec<_> = there.iter().filter(|path| path.is_dir()).map(|path| file_name(path)).collect();
    folders.sort();
    let mut text = String::new();
    if let Some(first) = folders.first() {
        text += &format!("; {} folders are in it, such as `{first}`: name that which has them", folders.len());
    }
    if !lost.is_empty() {
        text += &format!("; {} links lead nowhere", lost.len());
    }
    text
}

/// The files of a folder, sorted by format.
struct Listing {
    folder: PathBuf,
    frames: BTreeMap<Format, Vec<Candidate>>,
    /// Number of other images and files, by kind.
    others: BTreeMap<String, usize>,
}

impl Listing {
    fn read(folder: &Path, progress: &mut Progress<'_>) -> Result<Self> {
        let mut listing = Self { folder: folder.to_owned(), frames: BTreeMap::new(), others: BTreeMap::new() };
        let files = sorted_files(folder, "", progress);
        let files = files.with_context(|| format!("`{}` cannot be listed", folder.display()))?;
        let count = files.len();
        for (number, path) in (1..).zip(files) {
            progress(number, count);
            match format_of(&path) {
                Some(format) => listing.add(format, path),
                None => listing.add_other(other_kind(&path)),
            }
        }
        listing.keep_those_called_depth();
        Ok(listing)
    }

    fn add(&mut self, format: Format, path: PathBuf) {
        let candidate = match format {
            _ if !path.exists() => {
                let lost = Hinted::new("a link that leads nowhere", "is the disk there that it leads to?");
                Candidate { size: Err(lost.into()), path, stamp_ns: None }
            }
            Format::Png => match depth_png::probe(&path) {
                Ok(picture @ depth_png::Content::Picture(..)) => return self.add_other(picture.name()),
                content => {
                    let size = content.and_then(depth_png::Content::depth_size);
                    Candidate { size: size.map_err(|error| hinted(error, format.hint())), path, stamp_ns: None }
                }
            },
            _ => format.candidate(path),
        };
        self.frames.entry(format).or_default().push(candidate);
    }

    fn add_other(&mut self, what: String) {
        *self.others.entry(what).or_default() += 1;
    }

    /// Returns the error text for a folder without depth frames, with the kinds of its files.
    fn without_frames(&self) -> String {
        let folder = self.folder.display();
        let kinds: Vec<_> = self.others.iter().map(|(what, count)| format!("{count} of {what}")).collect();
        let what = match kinds.is_empty() {
            true => format!("no depth frames in `{folder}`, and no other files"),
            false => format!("no depth frames in `{folder}`, only other images and files: {}", kinds.join(", ")),
        };
        format!("{what}{}", other_entries(&self.folder))
    }

    /// If some names contain `depth`, drops the other images: they are infrared images, labels or the like.
    fn keep_those_called_depth(&mut self) {
        let called_depth = |frame: &Candidate| file_name(&frame.path).to_lowercase().contains("depth");
        for (_, frames) in self.frames.iter_mut().filter(|(format, _)| **format != Format::Pcd) {
            if frames.iter().any(called_depth) {
                frames.retain(called_depth);
            }
        }
    }

    fn has_frames(&self) -> bool {
        !self.frames.is_empty()
    }

    fn into_layout(mut self) -> Result<Layout> {
        let formats: Vec<_> = self.frames.keys().map(|format| format.files()).collect();
        let folder = self.folder.display();
        if formats.len() > 1 {
            bail!(Hinted::new(
                format!("`{folder}` holds {}, expected one kind", formats.join(" and ")),
                "move one of them to a folder of its own"
            ));
        }
        let Some((format, frames)) = self.frames.pop_first() else {
            return Err(anyhow!(Hinted::new(
                self.without_frames(),
                "depth frames are 16-bit grey PNGs, TIFF or NPY files, or organised PCD files"
            )));
        };
        Ok(Layout::new(format, &self.folder, format.depth_scale(), frames))
    }
}

/// Returns the files with this ending that are not hidden, in natural order of their names.
pub(super) fn sorted_files(folder: &Path, ending: &str, progress: &mut Progress<'_>) -> std::io::Result<Vec<PathBuf>> {
    /// Number of names that are listed, or compared, between two reports of progress.
    const AT_ONCE: usize = 1024;
    let mut names = Vec::new();
    for (listed, entry) in (1..).zip(fs::read_dir(folder)?) {
        if listed % AT_ONCE == 0 {
            progress(0, listed);
        }
        let entry = entry?;
        let (name, kind) = (entry.file_name(), entry.file_type()?);
        let text = name.to_string_lossy();
        // A link counts as its target. A broken link with the name of a frame counts as an unreadable frame.
        let leads_to_file = |path: &Path| path.metadata().map_or_else(|_| format_of(path).is_some(), |to| to.is_file());
        let is_wanted = || kind.is_file() || (kind.is_symlink() && leads_to_file(&entry.path()));
        if !text.starts_with('.') && text.ends_with(ending) && is_wanted() {
            names.push(name);
        }
    }
    let (count, mut compared) = (names.len(), 0);
    // Sorts names rather than paths, whose common prefix would take longest to compare.
    names.sort_unstable_by(|one, other| {
        compared += 1;
        if compared % AT_ONCE == 0 {
            progress(0, count);
        }
        alphanumeric_sort::compare_os_str(one, other)
    });
    Ok(names.into_iter().map(|name| folder.join(name)).collect())
}

/// The name of a file, as text.
pub(super) fn file_name(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}
