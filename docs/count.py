#!/usr/bin/env python3
"""Counts the numbers of the detection by class, the files and functions from image to objects, and the circles of imports:
`python3 docs/count.py`, from the root of the repository.

From image to objects are the files that `detection/src/method.rs` imports from, there and in `geometry`, and so on. Tests do not
count, nor do the types of `messages`.
"""

import re
import sys
from collections import Counter
from pathlib import Path

sys.dont_write_bytecode = True
from circles import PACKAGES, USE, circles, home, is_large, leaves, reach, read

CLASS = re.compile(r"\[(?:derived|sigmas|algorithmic|tuned|measured|fitted)\]")
FUNCTION = re.compile(r"(?<!#\[cfg\(test\)\]\n)^ *(?:pub(?:\(\w+\))? )?(?:const )?fn \w+", re.MULTILINE)


def with_imports(root, starts):
    """The texts, by path, of the files that define `starts`, names of a package, and of those that these import from."""
    files, texts, named = read(root)
    reached = reach(files, named)
    first = {home(start, files, named) for start in starts}
    return {files[module]: texts[module] for module in first.union(*(reached[module] for module in first))}


def from_image_to_objects():
    detection = with_imports(Path("detection/src"), [("method",)])
    paths = [path for text in detection.values() for tree in USE.findall(text) for path in leaves(tree)]
    from_geometry = [tuple(path[1:]) for path in paths if path[0] == "conicflow_geometry"]
    return detection | with_imports(Path("geometry/src"), from_geometry)


sources = [path.read_text() for root in ("detection/src", "geometry/src") for path in Path(root).rglob("*.rs")]
classes = Counter(tag for text in sources for tag in CLASS.findall(text))
print("numbers:", ", ".join(f"{classes[tag]} {tag}" for tag in sorted(classes)))
texts = from_image_to_objects()
functions = sum(len(FUNCTION.findall(text)) for text in texts.values())
print(f"from image to objects: {len(texts)} files, {functions} functions")
found = [circle for package in PACKAGES for circle in circles(Path(package))]
large = sum(map(is_large, found))
print(f"circles of imports: {len(found) - large} of two files of one folder, {large} larger")
