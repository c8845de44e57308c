"""The time of `conicflow.detect` on arrays, beside that of the detector in Rust on the same frames, measured alternately.

    cargo build --release --examples --manifest-path python/Cargo.toml
    python3 python/benches/detect.py python/target/release/examples/detect
"""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

import numpy as np
import scenes

import conicflow

ROUNDS, TURNS = 20, 7
scenes.WIDTH, scenes.HEIGHT, scenes.CAMERA = 640, 480, (525.0, 525.0, 319.5, 239.5)


def of_rust(program, path):
    arguments = [program, path, scenes.WIDTH, scenes.HEIGHT, *scenes.CAMERA, ROUNDS]
    lines = subprocess.run([*map(str, arguments)], capture_output=True, text=True, check=True).stdout.split()
    return [float(number) for number in lines[::2]], sum(map(int, lines[1::2]))


def of_python(detect, frames):
    times, found = [], 0
    for _ in range(ROUNDS):
        for frame in frames:
            start = time.perf_counter()
            objects = detect(frame)
            times.append(1e3 * (time.perf_counter() - start))
            found += len(objects)
    return times, found


def main():
    frames = np.stack([scenes.millimetres(seed) for seed in range(5)])
    wide = np.zeros((5, scenes.HEIGHT, scenes.WIDTH + 8), np.uint16)
    wide[:, :, 8:] = frames
    detector = conicflow.Detector(scenes.CAMERA)
    ways = {
        "conicflow.detect": lambda frame: conicflow.detect(frame, camera=scenes.CAMERA),
        "Detector.detect": detector.detect,
    }
    with tempfile.NamedTemporaryFile() as file:
        frames.tofile(file.name)
        times = {}
        for _ in range(TURNS):
            turn = {"Rust": of_rust(sys.argv[1], file.name)}
            turn |= {name: of_python(way, frames) for name, way in ways.items()}
            turn["conicflow.detect, strided"] = of_python(ways["conicflow.detect"], wide[:, :, 8:])
            assert len({found for _, found in turn.values()}) == 1, "not the same objects"
            for name, (taken, _) in turn.items():
                times.setdefault(name, []).extend(taken)
    least = {name: np.percentile(taken, 10) for name, taken in times.items()}
    print(f"{'':27}{'min':>9}{'p10':>9}{'p50':>9}  p10 by that of Rust")
    for name, taken in times.items():
        print(f"{name:27}{min(taken):9.3f}{least[name]:9.3f}{np.median(taken):9.3f}  {least[name] / least['Rust']:.3f}")


if __name__ == "__main__":
    main()
