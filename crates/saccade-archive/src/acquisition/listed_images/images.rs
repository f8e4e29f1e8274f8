//! A folder as it lies.

use std::fs;
use std::path::{Path, PathBuf};

use super::super::AcquisitionError;
use super::{Ends, Files, Mentions, Seeker, Sought};

/// The images below a folder, as they lay when it was looked through.
#[derive(Clone, Debug)]
pub struct Images {
    root: PathBuf,
    /// Below the root.
    paths: Ends<PathBuf>,
}

impl Images {
    /// Looks through a folder and the folders in it.
    ///
    /// # Errors
    ///
    /// [`AcquisitionError::Read`] for a folder that cannot be listed.
    pub fn below(folder: &Path) -> Result<Self, AcquisitionError> {
        let mut paths = Ends::default();
        let mut open = vec![PathBuf::new()];
        while let Some(at) = open.pop() {
            let here = folder.join(&at);
            let failed = |source| AcquisitionError::Read {
                source,
                path: here.clone(),
            };
            for entry in fs::read_dir(&here).map_err(failed)? {
                let entry = entry.map_err(failed)?;
                let kind = entry.file_type().map_err(failed)?;
                let path = at.join(entry.file_name());
                if kind.is_dir() {
                    open.push(path);
                } else if entry.file_name().to_str().is_some() {
                    paths.insert(&path.to_string_lossy(), path.clone());
                }
            }
        }
        Ok(Self {
            root: folder.to_owned(),
            paths,
        })
    }

    /// Of a list's images: the path of each that it calls so, in the list's order, or none. Of several that may be meant the
    /// smallest is taken; [`Self::several`] says so.
    pub fn of_list<'a>(
        &self,
        files: impl Iterator<Item = &'a str> + Clone,
    ) -> Vec<Option<PathBuf>> {
        let mentions = Mentions::of(files.clone());
        let seeker = self.seeker(&mentions);
        files
            .map(|file| match seeker.sought(file) {
                Sought::There(path) => Some(self.root.join(path)),
                Sought::Several([one, _]) => Some(self.root.join(one)),
                Sought::Missing => None,
            })
            .collect()
    }

    /// Two images that may be meant as well by what a list calls one, for each such.
    pub fn several<'a>(&self, files: impl Iterator<Item = &'a str> + Clone) -> Vec<[PathBuf; 2]> {
        let mentions = Mentions::of(files.clone());
        let seeker = self.seeker(&mentions);
        files
            .filter_map(|file| match seeker.sought(file) {
                Sought::Several(both) => Some(both.map(|path| self.root.join(path))),
                Sought::There(_) | Sought::Missing => None,
            })
            .collect()
    }

    /// Whether any image may be what a list calls `file`, whatever else it names.
    pub fn has(&self, file: &str) -> bool {
        let alone = Mentions::default();
        self.seeker(&alone).sought(file) != Sought::Missing
    }

    fn seeker<'a>(&'a self, mentions: &'a Mentions) -> Seeker<'a, Self> {
        Seeker {
            files: self,
            mentions,
        }
    }
}

impl Files for Images {
    fn is_there(&self, path: &Path) -> bool {
        self.root.join(path).is_file()
    }

    fn is_folder(&self, path: &Path) -> bool {
        self.root.join(path).is_dir()
    }

    fn called(&self, name: &str, folders: &str) -> impl Iterator<Item = PathBuf> {
        let found = self.paths.ending(&format!("{folders}/{name}"));
        found.cloned()
    }
}

#[cfg(test)]
mod tests {
    use super::super::{NotTaken, conformance};
    use super::*;

    /// What is found below a root for a list of this image alone.
    fn alone(images: &Images, file: &str, root: &Path) -> Option<PathBuf> {
        let [found] = images.of_list([file].into_iter()).try_into().unwrap();
        assert_eq!(images.has(file), found.is_some());
        Some(found?.strip_prefix(root).unwrap().to_owned())
    }

    fn several(images: &Images, file: &str) -> Option<[PathBuf; 2]> {
        images.several([file].into_iter()).pop()
    }

    /// A name's twin in another section's folder is no reason to take that one's.
    #[test]
    fn an_image_that_is_as_much_like_another_is_none() {
        let folder = tempfile::tempdir().unwrap();
        for file in [
            "s00/raw/r.tif",
            "s02/raw/r.tif",
            "deep/s03/raw/r.tif",
            "raw/one.tif",
        ] {
            let path = folder.path().join(file);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, "").unwrap();
        }
        let images = Images::below(folder.path()).unwrap();
        for (before, slash) in [
            ("", "/"),
            ("/scope/", "//"),
            ("C:\\scope\\", "\\"),
            ("./", "/./"),
        ] {
            let listed = [0, 1, 2, 3].map(|z| format!("{before}s{z:02}{slash}raw{slash}r.tif"));
            let files = listed.iter().map(String::as_str).chain(["x/one.tif"]);
            let found = images.of_list(files.clone());
            let below = |path: &PathBuf| path.strip_prefix(folder.path()).unwrap().to_owned();
            let found: Vec<_> = { found.iter() }
                .map(|path| path.as_ref().map(below))
                .collect();
            let there = |path: &str| Some(PathBuf::from(path));
            assert_eq!(
                found,
                [
                    there("s00/raw/r.tif"),
                    None,
                    there("s02/raw/r.tif"),
                    there("deep/s03/raw/r.tif"),
                    there("raw/one.tif"),
                ],
                "{before}"
            );
            assert!(images.several(files).is_empty());
        }
        // The only one of a name may be anywhere; of others so may none that is as much like another.
        let files = [
            "r.tif",
            "s00/r.tif",
            "/far/s01/r.tif",
            "s%202/r.tif",
            "x/one.tif",
        ];
        let mentions = Mentions::of(files.into_iter());
        let seeker = images.seeker(&mentions);
        let may_be = |path: &str| {
            let path = Path::new(path);
            files.map(|file| seeker.may_be(path, file))
        };
        assert_eq!(may_be("r.tif"), [true, false, false, false, false]);
        assert_eq!(may_be("s00/r.tif"), [false, true, false, false, false]);
        assert_eq!(may_be("deep/s01/r.tif"), [false, false, true, false, false]);
        assert_eq!(may_be("s 2/r.tif"), [false, false, false, true, false]);
        assert_eq!(may_be("raw/r.tif"), [false; 5]);
        assert_eq!(may_be("raw/one.tif"), [false, false, false, false, true]);
        // Alone it may be any.
        assert!(several(&images, "/scope/s01/raw/r.tif").is_some());
    }

    #[test]
    fn are_files() {
        let root = tempfile::tempdir().unwrap();
        conformance::check(root.path(), |root| Images::below(root).unwrap());
    }

    /// What is there and not taken is told, with the reason, so that a user need not look.
    #[test]
    fn why_an_image_is_not_taken_is_told() {
        let folder = tempfile::tempdir().unwrap();
        for file in ["s00/raw/r.tif", "raw/q.tif", "s01/a b.tif", "s01/one.tif"] {
            let path = folder.path().join(file);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, "").unwrap();
        }
        let images = Images::below(folder.path()).unwrap();
        let files = [
            "s00/raw/r.tif",
            "s01/raw/r.tif",
            "s01/raw/q.tif",
            "s02/raw/q.tif",
            "raw/a%20b.tif",
            "x/one.tif",
            "none.tif",
        ];
        let mentions = Mentions::of(files.into_iter());
        let seeker = images.seeker(&mentions);
        let why = |file| {
            let taken = seeker.sought(file) != Sought::Missing;
            let (path, why) = seeker.not_taken(file)?;
            assert!(!taken, "{file}");
            Some((path.to_str()?.to_owned(), why))
        };
        let some = |path: &str, why| Some((path.to_owned(), why));
        assert_eq!(
            files.map(why),
            [
                None,
                some("s00/raw/r.tif", NotTaken::AsAnother),
                some("raw/q.tif", NotTaken::AsAnother),
                some("raw/q.tif", NotTaken::AsAnother),
                some("s01/a b.tif", NotTaken::Elsewhere),
                None,
                None,
            ]
        );
    }

    #[test]
    fn paths_that_end_alike_are_found_by_their_ends() {
        let mut ends = Ends::default();
        for (n, path) in [
            "a/raw", "b/raw", "b/xraw", "c/b/raw", "raw", "raw/b", "é/raw",
        ]
        .iter()
        .enumerate()
        {
            ends.insert(path, n);
        }
        let found = |end: &str| {
            let mut found: Vec<_> = ends.ending(end).copied().collect();
            found.sort_unstable();
            found
        };
        assert_eq!(found("raw"), [0, 1, 3, 4, 6]);
        assert_eq!(found("b/raw"), [1, 3]);
        assert_eq!(found("/b//raw"), [1, 3]);
        assert_eq!(found("c/b/raw"), [3]);
        assert_eq!(found("xraw"), [2]);
        assert_eq!(found("b"), [5]);
        assert!(found("aw").is_empty() && found("d/raw").is_empty());
        assert_eq!(found("").len(), 7);
    }

    #[test]
    fn images_are_found_by_name() {
        let folder = tempfile::tempdir().unwrap();
        fs::create_dir_all(folder.path().join("deep/er")).unwrap();
        fs::create_dir_all(folder.path().join("other")).unwrap();
        for file in ["deep/er/a.tif", "other/a.tif", "b.tif"] {
            fs::write(folder.path().join(file), "").unwrap();
        }
        let images = Images::below(folder.path()).unwrap();
        let found = |file| alone(&images, file, folder.path());
        assert_eq!(found("other/a.tif").unwrap(), Path::new("other/a.tif"));
        assert_eq!(found("editme/a.tif").unwrap(), Path::new("deep/er/a.tif"));
        assert_eq!(found("C:\\scope\\b.tif").unwrap(), Path::new("b.tif"));
        assert_eq!(found("none.tif"), None);
        let [taken, other] = several(&images, "editme/a.tif").unwrap();
        assert!(taken.ends_with("deep/er/a.tif") && other.ends_with("other/a.tif"));
        for clear in ["other/a.tif", "b.tif", "none.tif"] {
            assert_eq!(several(&images, clear), None, "{clear}");
        }
    }

    #[test]
    fn names_of_urls_are_found_decoded_where_no_file_has_them_as_they_are() {
        let folder = tempfile::tempdir().unwrap();
        fs::create_dir_all(folder.path().join("in/a b")).unwrap();
        fs::create_dir_all(folder.path().join("other")).unwrap();
        let files = [
            "in/t#1.tif",
            "in/ü.tif",
            "in/both 1.tif",
            "other/both%201.tif",
            "in/50%.tif",
            "in/100%2525.tif",
            "in/a b/same.tif",
            "in/same.tif",
            "x.tif",
        ];
        for file in files {
            fs::write(folder.path().join(file), "").unwrap();
        }
        // What lies beside the folder is out of reach.
        let inner = folder.path().join("in");
        let all = Images::below(folder.path()).unwrap();
        let inside = Images::below(&inner).unwrap();
        let found = |images: &Images, file| alone(images, file, folder.path());
        for (listed, there) in [
            ("/scope/a%20b/t%231.tif", "in/t#1.tif"),
            ("in/t%231.tif", "in/t#1.tif"),
            ("/scope/%C3%BC.tif", "in/ü.tif"),
            ("/scope/50%25.tif", "in/50%.tif"),
            // As it is, also elsewhere, before what it means; but not where the folder that is named is there.
            ("/scope/in/both%201.tif", "other/both%201.tif"),
            ("in/both%201.tif", "in/both 1.tif"),
            ("/scope/100%2525.tif", "in/100%2525.tif"),
            // Where only the folder is encoded, it tells which one is meant.
            ("in/a%20b/same.tif", "in/a b/same.tif"),
        ] {
            assert_eq!(
                found(&all, listed).as_deref(),
                Some(Path::new(there)),
                "{listed}"
            );
        }
        assert_eq!(several(&all, "in/a%20b/same.tif"), None);
        assert!(several(&all, "/scope/s%61me.tif").is_some());
        for nothing in [
            "%2e%2e%2fx.tif",
            "%2E%2E/x.tif",
            "a%20b%2Fsame.tif",
            "..%5cx.tif",
            "%2e%2e",
            "%2e",
            "x%00.tif",
            "%ff.tif",
            "t%2.tif",
            "t%zz1.tif",
        ] {
            assert_eq!(found(&inside, nothing), None, "{nothing}");
        }
    }
}
