//! The files of the page. They are part of the program: a browser needs no files and no network.

/// A file of the page: its path, its type, its content.
type File = (&'static str, &'static str, &'static [u8]);

const SCRIPT: &str = "text/javascript; charset=utf-8";

/// All files.
const FILES: &[File] = &[
    ("/", "text/html; charset=utf-8", include_bytes!("../page/index.html")),
    ("/style.css", "text/css; charset=utf-8", include_bytes!("../page/style.css")),
    ("/icon.svg", "image/svg+xml", include_bytes!("../page/icon.svg")),
    ("/main.js", SCRIPT, include_bytes!("../page/main.js")),
    ("/server.js", SCRIPT, include_bytes!("../page/server.js")),
    ("/colours.js", SCRIPT, include_bytes!("../page/colours.js")),
    ("/words.js", SCRIPT, include_bytes!("../page/words.js")),
    ("/elements.js", SCRIPT, include_bytes!("../page/elements.js")),
    ("/image.js", SCRIPT, include_bytes!("../page/image.js")),
    ("/labels.js", SCRIPT, include_bytes!("../page/labels.js")),
    ("/space.js", SCRIPT, include_bytes!("../page/space.js")),
    ("/shapes.js", SCRIPT, include_bytes!("../page/shapes.js")),
    ("/trails.js", SCRIPT, include_bytes!("../page/trails.js")),
    ("/list.js", SCRIPT, include_bytes!("../page/list.js")),
    ("/graph.js", SCRIPT, include_bytes!("../page/graph.js")),
    ("/timeline.js", SCRIPT, include_bytes!("../page/timeline.js")),
    ("/three/three.min.js", SCRIPT, include_bytes!("../page/three/three.min.js")),
    ("/three/LICENSE", "text/plain; charset=utf-8", include_bytes!("../page/three/LICENSE")),
];

/// Returns the type and the content of the file at a path.
pub(crate) fn file(path: &str) -> Option<(&'static str, &'static [u8])> {
    FILES.iter().find(|(known, ..)| *known == path).map(|(_, kind, content)| (*kind, *content))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// All files that pages or scripts refer to exist, and none refers to another host.
    #[test]
    fn the_page_loads_only_files_of_the_server() {
        for (path, kind, content) in FILES.iter().filter(|(path, ..)| !path.starts_with("/three/")) {
            let text = std::str::from_utf8(content).unwrap();
            assert!(!text.contains("//cdn") && !text.contains("https://"), "{path} names something elsewhere");
            if *kind != SCRIPT {
                continue;
            }
            let names = text.lines().filter_map(|line| line.split_once(" from \"")?.1.strip_suffix("\";"));
            for name in names {
                let named = name.replacen('.', "", 1);
                assert!(file(&named).is_some(), "{path} names `{name}`, which is not there");
            }
        }
        assert!(file("/../Cargo.toml").is_none() && file("/page/main.js").is_none());
    }

    #[test]
    fn the_licence_of_the_drawing_library_is_served_with_it() {
        let (_, licence) = file("/three/LICENSE").unwrap();
        assert!(std::str::from_utf8(licence).unwrap().contains("three.js authors"));
    }
}
