//! Free space on the disk of the recordings.

use std::path::Path;

use sysinfo::Disks;

/// Less than this raises an alarm during a recording \[bytes\]. Three cars fill it in about forty minutes.
pub(super) const SCARCE: u64 = 1_000_000_000;

/// Free bytes on the disk of `folder`; None if the system does not report them.
pub fn free(folder: &Path) -> Option<u64> {
    let folder = folder.canonicalize().ok()?;
    let disks = Disks::new_with_refreshed_list();
    disks
        .iter()
        .filter(|disk| folder.starts_with(disk.mount_point()))
        .max_by_key(|disk| disk.mount_point().as_os_str().len())
        .map(sysinfo::Disk::available_space)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_that_is_not_there_has_no_room() {
        assert_eq!(free(Path::new("/no/such/folder")), None);
    }
}
