#!/usr/bin/env python3
"""Lists circles of imports between the files of each package: `python3 docs/circles.py [FOLDER]...`.

A name is imported from the file that defines it, whatever re-exports it; tests and comments do not count. Ends with 1 where a
circle joins files of different folders, or more than two files.
"""

import re
import sys
from pathlib import Path

PACKAGES = [*sorted(map(str, Path(".").glob("*/src"))), "nodes"]
USE = re.compile(r"^ *(?:pub(?:\(\w+\))? )?use ([^;]+);", re.MULTILINE)
TESTS = re.compile(r"^#\[cfg\(test\)\]\n(?:pub(?:\(\w+\))? )?mod \w+ \{", re.MULTILINE)
COMMENT = re.compile(r" *//.*")
PATH = re.compile(r"(?<![\w:])[a-z_]\w*(?:::\w+)+(?![\w:])")  # in the midst of code


def leaves(tree):
    """The paths of a `use`: `a::{b, c::{d, e}}` into [a, b], [a, c, d], [a, c, e]."""
    group = re.search(r"([\w:]*)\{([^{}]*)\}", tree)
    if group:
        names = [group[1] + name.strip() for name in group[2].split(",") if name.strip()]
        return leaves(tree[: group.start()] + ",".join(names) + tree[group.end() :])
    return [re.sub(r" as \w+", "", name).strip().split("::") for name in tree.split(",")]


def uses(module, text, files):
    """What a file names of its package, as paths from the root of that."""
    for path in [leaf for tree in USE.findall(text) + PATH.findall(text) for leaf in leaves(tree)]:
        if path[0] in ("crate", "super", "self") or module + (path[0],) in files:
            at = list(module)
            for name in path:
                at = [] if name == "crate" else at[:-1] if name == "super" else at + [name] if name != "self" else at
            yield tuple(at)


def home(path, files, named):
    """The module that defines what a path names."""
    known = max((path[:length] for length in range(len(path) + 1) if path[:length] in files), key=len)
    further = [use for use in named[known] if use[:-1] != known and use[-1:] == path[len(known) :][:1]]
    return home(further[0], files, named) if further else known


def read(root):
    """The files of a package by module, their texts without tests and comments, and what each names of the package."""
    files = {}
    for path in [path for path in sorted(root.rglob("*.rs")) if not path.stem.endswith("tests")]:
        module = path.relative_to(root).with_suffix("").parts
        files[module[:-1] if module[-1] in ("mod", "lib") else module] = path
    texts = {module: COMMENT.sub("", TESTS.split(path.read_text())[0]) for module, path in files.items()}
    named = {module: list(uses(module, text, files)) for module, text in texts.items()}
    return files, texts, named


def reach(files, named):
    """For each module those that it imports from, and those that these import from, and so on."""
    reached = {module: {home(path, files, named) for path in named[module]} - {module} for module in files}
    for middle in files:
        for module in [module for module in files if middle in reached[module]]:
            reached[module] |= reached[middle]
    return reached


def circles(root):
    files, _, named = read(root)
    reached = reach(files, named)
    joined = {frozenset(other for other in reached[module] if module in reached[other]) for module in files}
    return [sorted(files[module] for module in circle) for circle in joined if circle]


def is_large(circle):
    return len(circle) > 2 or len({path.parent for path in circle}) > 1


def main(folders):
    found = [circle for folder in folders for circle in circles(Path(folder))]
    print(*[" ".join(["circle:" if is_large(circle) else "pair:", *map(str, circle)]) for circle in found], sep="\n")
    return any(map(is_large, found))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:] or PACKAGES))
