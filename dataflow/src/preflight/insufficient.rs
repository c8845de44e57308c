//! Resources that a machine lacks for a run: what it has, and what is needed.

use super::Requirements;
use crate::ports::capacity::{SHARED_MEMORY, in_words, room};
use rustix::process::{Resource, getrlimit};

/// A resource of which a machine has too little.
#[derive(Debug, thiserror::Error)]
pub enum InsufficientResource {
    /// Shared memory is not available.
    #[error(
        "there is no shared memory in {SHARED_MEMORY}: {0}\n  hint: mount it: \
         `mkdir -p {SHARED_MEMORY} && mount -t tmpfs -o mode=1777 tmpfs {SHARED_MEMORY}` as root"
    )]
    NoSharedMemory(std::io::Error),
    /// The messages of a run that can exist at once do not fit.
    #[error(
        "shared memory has {} of {} free in {SHARED_MEMORY}, this pipeline needs up to {}, most of it for the topic \
         `{topic}`\n  hint: `conicflow doctor` finds what dead runs have left there; to enlarge it, `mount -o \
         remount,size={wanted}M {SHARED_MEMORY}` as root, for a container `--shm-size={wanted}m`; \
         smaller images and shorter queues need less",
        in_words(*.free), in_words(*.size), in_words(*.needed)
    )]
    Room {
        /// Bytes that are free.
        free: u64,
        /// Size of the shared memory in bytes.
        size: u64,
        /// Maximum number of bytes that the pipeline takes.
        needed: u64,
        /// The topic that takes most of them.
        topic: String,
        /// Recommended size in megabytes.
        wanted: u64,
    },
    /// An addition to a running pipeline does not fit.
    #[error(
        "to {purpose} takes up to {} of shared memory, {} are free in {SHARED_MEMORY}\n  hint: `conicflow doctor` finds \
         what dead runs have left there", in_words(*.needed), in_words(*.free)
    )]
    MoreRoom {
        /// Purpose of the additional memory.
        purpose: String,
        /// Bytes that are free.
        free: u64,
        /// Maximum number of bytes that it takes.
        needed: u64,
    },
    /// A stage or the launcher could not open all its files.
    #[error(
        "a process may have {limit} files open, one of this pipeline needs up to {needed}\n  \
         hint: `ulimit -n {needed}` in the shell before it is started; in a systemd unit `LimitNOFILE={needed}`"
    )]
    OpenFiles {
        /// Maximum number of open files of a process.
        limit: u64,
        /// Maximum number of files that a stage or the launcher opens.
        needed: u64,
    },
}

impl Requirements {
    /// Resources of which this machine has too little now.
    pub fn insufficient(&self) -> Vec<InsufficientResource> {
        let files = self.short_of_files();
        let room = match room() {
            Ok((free, size)) => self.short_of_room(free, size),
            Err(error) => Some(InsufficientResource::NoSharedMemory(error)),
        };
        room.into_iter().chain(files).collect()
    }

    /// Error if a process of the run needs more open files than the limit allows.
    pub(crate) fn short_of_files(&self) -> Option<InsufficientResource> {
        let limit = getrlimit(Resource::Nofile).current.unwrap_or(u64::MAX);
        (limit < self.open_files).then_some(InsufficientResource::OpenFiles { limit, needed: self.open_files })
    }

    fn short_of_room(&self, free: u64, size: u64) -> Option<InsufficientResource> {
        let needed = self.shared_memory();
        let topic = &self.topics.iter().max_by_key(|requirements| requirements.bytes)?.name;
        let wanted = (size.saturating_sub(free) + needed).div_ceil(1 << 20).next_power_of_two();
        (free < needed).then(|| InsufficientResource::Room { free, size, needed, topic: topic.clone(), wanted })
    }
}

/// Checks that this many bytes of shared memory are free.
pub(super) fn enough(needed: u64, purpose: impl FnOnce() -> String) -> Result<(), InsufficientResource> {
    let (free, _) = room().map_err(InsufficientResource::NoSharedMemory)?;
    if free < needed { Err(InsufficientResource::MoreRoom { purpose: purpose(), free, needed }) } else { Ok(()) }
}

#[cfg(test)]
mod tests {
    use super::super::TopicRequirements;
    use super::*;

    #[test]
    fn a_shortfall_names_the_topic_and_what_would_do() {
        let topic = |name: &str, bytes| TopicRequirements { name: name.to_owned(), bytes, longest_message: 1 };
        let topics = vec![topic("small", 1 << 20), topic("large", 70 << 20)];
        let requirements = Requirements { topics, ..Requirements::default() };
        assert!(requirements.short_of_room(71 << 20, 80 << 20).is_none(), "just enough");
        let insufficient = requirements.short_of_room((71 << 20) - 1, 80 << 20).unwrap().to_string();
        assert!(insufficient.starts_with("shared memory has 74.4 MB of 83.9 MB free"), "{insufficient}");
        assert!(insufficient.contains("needs up to 74.4 MB, most of it for the topic `large`\n"), "{insufficient}");
        assert!(insufficient.contains("size=128M"), "80 MB less 71 are taken, 71 are needed: {insufficient}");
    }
}
