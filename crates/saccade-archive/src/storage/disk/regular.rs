//! Opening what is a file, and nothing else.

use std::fs::{File, OpenOptions};
use std::io::{self, Read as _};
use std::path::Path;

/// Opens a file for reading. A folder is opened, too, and says what it is when it is read.
///
/// # Errors
///
/// [`io::ErrorKind::NotSeekable`] for a named pipe, a socket or a device, of which nothing is read: whoever opened a pipe to
/// which nobody writes would wait for ever. What the system says.
pub(crate) fn open_regular(path: &Path) -> io::Result<File> {
    let mut options = OpenOptions::new();
    options.read(true);
    #[cfg(unix)]
    {
        use std::os::unix::fs::OpenOptionsExt as _;
        // Pipes open at once then, and files are read as ever.
        options.custom_flags(rustix::fs::OFlags::NONBLOCK.bits().cast_signed());
    }
    let no_file = || io::Error::new(io::ErrorKind::NotSeekable, "it is no regular file");
    let is_one = |kind: std::fs::FileType| kind.is_file() || kind.is_dir();
    let file = match options.open(path) {
        // Sockets cannot be opened.
        Err(error) => match std::fs::metadata(path) {
            Ok(there) if !is_one(there.file_type()) => return Err(no_file()),
            _ => return Err(error),
        },
        Ok(file) => file,
    };
    match is_one(file.metadata()?.file_type()) {
        true => Ok(file),
        false => Err(no_file()),
    }
}

/// What is in a file, see [`open_regular`].
///
/// # Errors
///
/// As of [`open_regular`].
pub(crate) fn read_regular(path: &Path) -> io::Result<Vec<u8>> {
    let mut file = open_regular(path)?;
    let mut bytes = Vec::new();
    file.read_to_end(&mut bytes)?;
    Ok(bytes)
}
