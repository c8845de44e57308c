//! Reduces the resident memory of a process: once it is at work, it returns pages that only its start needed.
//!
//! Reading a plan and opening ports runs through most of the program once, and the system maps 64 kB around each place touched: 8
//! MB that a stage, whose loop needs 1 MB, would keep resident. Unmodified pages are read from the file again when they are
//! needed; freed memory is returned by the allocator.

use std::fs;
use std::ops::Range;

/// Bytes of the stack that are kept below the part in use.
const SPARE_STACK: usize = 64 * 1024;
/// Maximum size of a page in bytes.
const PAGE: usize = 64 * 1024;

/// Returns unmodified pages of the program and its libraries, unused stack, and free memory of the allocator to the system. If
/// the system does not list such pages, or refuses them, they stay.
pub(crate) fn trim() {
    let mappings = fs::read_to_string("/proc/self/smaps").unwrap_or_default();
    let here = std::ptr::from_ref(&mappings).addr();
    for range in unwritten(&mappings).into_iter().chain(unused_stack(&mappings, here)) {
        // SAFETY: the range is a mapping that the system listed, or a part of one. Pages of read-only file mappings without
        // modified pages are read from the file again at the next access. Below the frames of this thread, with room for those of
        // a signal, nothing on its stack is alive.
        unsafe { libc::madvise(range.start as *mut libc::c_void, range.len(), libc::MADV_DONTNEED) };
    }
    #[cfg(target_env = "gnu")]
    // SAFETY: the allocator returns only memory that is free.
    unsafe {
        libc::malloc_trim(0)
    };
}

/// Part of the main thread's stack that is not in use, if the address `here` is on that stack.
fn unused_stack(mappings: &str, here: usize) -> Option<Range<usize>> {
    let line = mappings.lines().find(|line| line.ends_with("[stack]"))?;
    let stack = addresses(line)?;
    let unused = stack.start..here.saturating_sub(SPARE_STACK) / PAGE * PAGE;
    (stack.contains(&here) && !unused.is_empty()).then_some(unused)
}

/// Read-only mappings of programs and libraries without modified pages, neither in memory nor swapped out.
fn unwritten(mappings: &str) -> Vec<Range<usize>> {
    let (mut found, mut current, mut none_here) = (Vec::new(), None, false);
    for line in mappings.lines() {
        let mut words = line.split_whitespace();
        if let Some(mapping) = file_mapping(line) {
            (current, none_here) = (mapping, false);
        } else if words.next() == Some("Anonymous:") {
            none_here = words.next() == Some("0");
        } else if none_here && line.split_whitespace().eq(["Swap:", "0", "kB"]) {
            found.extend(current.take());
        }
    }
    found
}

/// Parses the first line of a mapping; `Some(range)` if it maps a file read-only. The outer `None`: another line.
fn file_mapping(line: &str) -> Option<Option<Range<usize>>> {
    let range = addresses(line)?;
    let mut words = line.split_whitespace().skip(1);
    let (permissions, path) = (words.next()?, words.nth(3));
    let fixed = matches!(permissions, "r-xp" | "r--p") && path.is_some_and(|path| path.starts_with('/'));
    Some(fixed.then_some(range))
}

/// Address range at the start of a mapping's first line.
fn addresses(line: &str) -> Option<Range<usize>> {
    let (start, end) = line.split_whitespace().next()?.split_once('-')?;
    let address = |text| usize::from_str_radix(text, 16).ok();
    Some(address(start)?..address(end)?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::fd::AsRawFd;

    const MAPPINGS: &str = "\
1000-3000 r--p 00000000 fe:00 11 /bin/program
Rss:                   8 kB
Anonymous:             0 kB
Swap:                  0 kB
VmFlags: rd mr mw me
3000-9000 r-xp 00002000 fe:00 11 /bin/program
Anonymous:             0 kB
Swap:                  0 kB
9000-a000 r--p 00008000 fe:00 11 /bin/program
Anonymous:             4 kB
Swap:                  0 kB
a000-b000 rw-p 00009000 fe:00 11 /bin/program
Anonymous:             0 kB
Swap:                  0 kB
b000-c000 r--p 00000000 00:00 0
Anonymous:             0 kB
Swap:                  0 kB
c000-d000 r-xp 00000000 00:00 0 [vdso]
Anonymous:             0 kB
Swap:                  0 kB
d000-e000 rw-s 00000000 00:1b 5 /dev/shm/segment
Anonymous:             0 kB
Swap:                  0 kB
e000-f000 r--p 00000000 fe:00 12 /lib/rare
Anonymous:             0 kB
Swap:                  4 kB
";

    #[test]
    fn only_what_is_as_in_its_file_is_given_back() {
        assert_eq!(unwritten(MAPPINGS), [0x1000..0x3000, 0x3000..0x9000]);
        assert!(unwritten("nonsense\nAnonymous: 0 kB\nSwap: 0 kB\n").is_empty());
    }

    #[test]
    fn of_the_stack_what_is_used_stays() {
        let stack = "7ff000000000-7ff000100000 rw-p 00000000 00:00 0    [stack]\nRss: 900 kB\n";
        assert_eq!(unused_stack(stack, 0x7ff0_000e_1234), Some(0x7ff0_0000_0000..0x7ff0_000d_0000));
        assert_eq!(unused_stack(stack, 0x7ff0_0001_1234), None, "all of it may be in use");
        assert_eq!(unused_stack(stack, 0x6ff0_0000_0000), None, "the stack of another thread");
    }

    #[test]
    fn pages_of_a_file_that_were_read_once_are_given_back() {
        const LENGTH: usize = 1 << 20;
        let file = tempfile::NamedTempFile::new().unwrap();
        fs::write(file.path(), vec![7; LENGTH]).unwrap();
        let resident = || {
            let mappings = fs::read_to_string("/proc/self/smaps").unwrap();
            let mut own = mappings.lines().skip_while(|line| !line.ends_with(file.path().to_str().unwrap()));
            own.find_map(|line| line.strip_prefix("Rss:")).map(|size| size.trim().to_owned())
        };
        let descriptor = file.as_file().as_raw_fd();
        // SAFETY: a new mapping of a file of this length.
        let mapped =
            unsafe { libc::mmap(std::ptr::null_mut(), LENGTH, libc::PROT_READ, libc::MAP_PRIVATE, descriptor, 0) };
        assert_ne!(mapped, libc::MAP_FAILED);
        // SAFETY: the mapping lasts until the end of this test, and nobody writes the file.
        let bytes = unsafe { std::slice::from_raw_parts(mapped.cast::<u8>(), LENGTH) };
        assert!(bytes.iter().all(|byte| *byte == 7));
        trim();
        assert_eq!(resident().as_deref(), Some("0 kB"));
        assert!(bytes.iter().all(|byte| *byte == 7), "they come back from the file");
        // SAFETY: nothing refers to it any more.
        unsafe { libc::munmap(mapped, LENGTH) };
    }

    #[test]
    fn the_program_goes_on_afterwards() {
        let kept: Vec<u64> = (0..100_000).collect();
        trim();
        assert_eq!(kept.iter().sum::<u64>(), 4_999_950_000);
    }
}
