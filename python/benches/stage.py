"""The time of a depth image through a stage in Python, beside that of the same stage in Rust, measured alternately.

    cargo build --release --examples --manifest-path python/Cargo.toml
    python3 python/benches/stage.py target/release/conicflow python/target/release/examples/pass_on
"""

import re
import subprocess
import sys
import tempfile
from pathlib import Path

TURNS, FRAMES = 5, 300

PASS_ON = """
import conicflow

with conicflow.stage() as stage:
    for message in stage:
        stage.count("measured", int(message.image[0, 0] > 0))
        stage.send([])
"""

PIPELINE = """
name = "measured"

[stage.camera]
node    = "synthetic_source"
output  = "depth"
rate_hz = 30

[stage.passed]
program = {program}
input   = {{ topic = "depth", delivery = "lossless" }}
output  = {{ topic = "objects", kind = "objects" }}

[stage.end]
node  = "json_sink"
input = {{ topic = "objects", delivery = "lossless", kind = "objects" }}
path  = "objects.jsonl"
"""


def run(conicflow, program, folder):
    (folder / "pipeline.toml").write_text(PIPELINE.format(program=program))
    ended = subprocess.run([conicflow, "run", "--frames", str(FRAMES)], cwd=folder, capture_output=True, text=True)
    told = ended.stderr
    assert ended.returncode == 0, told
    stage = re.search(r"^passed .*?([\d.]+) ms +([\d.]+) ms", told, re.M)
    there = re.search(r"^depth +passed .*?([\d.]+) ms", told, re.M)
    back = re.search(r"^objects +end .*?([\d.]+) ms", told, re.M)
    return [1e3 * float(found[1]) for found in (there, stage, back)]


def main():
    conicflow, rust = (str(Path(path).resolve()) for path in sys.argv[1:3])
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        (folder / "pass_on.py").write_text(PASS_ON)
        programs = {"Rust": f'["{rust}"]', "Python": f'["{sys.executable}", "pass_on.py"]'}
        times = {name: [] for name in programs}
        for _ in range(TURNS):
            for name, program in programs.items():
                times[name].append(run(conicflow, program, folder))
    print("microseconds, medians of 300 frames, the lowest turn by their sum: hop to it, its step, hop from it, sum")
    for name, turns in times.items():
        best = min(turns, key=sum)
        print(f"{name:8}", *(f"{number:8.0f}" for number in [*best, sum(best)]), "  sums:", *(f"{sum(t):.0f}" for t in turns))


if __name__ == "__main__":
    main()
