"""Depth of 240 generated pairs of 960×540 px, 96 disparities: a single-threaded loop, and two workers of Ray Data.

Run on an idle machine: processor time is that of the whole machine, from /proc/stat, to include Ray's own processes. The marginal cost of additional pairs is compared, without Ray's start.

    python benchmarks/ray_depth.py [PAIRS]
"""

import os
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import numpy as np

import epipole
import epipole.ray

DISPARITIES = 96


def busy():
    """Returns the busy processor time of the machine in seconds."""
    with open("/proc/stat") as file:
        ticks = [int(n) for n in file.readline().split()[1:]]
    return (sum(ticks[:3]) + sum(ticks[5:8])) / os.sysconf("SC_CLK_TCK")


def resident():
    """Returns the memory of Ray's processes in bytes, with shared pages counted once (PSS)."""
    total = 0
    for entry in filter(str.isdigit, os.listdir("/proc")):
        try:
            command = Path(f"/proc/{entry}/cmdline").read_bytes()
            if b"ray" in command and int(entry) != os.getpid():
                rows = Path(f"/proc/{entry}/smaps_rollup").read_text().splitlines()
                total += next(int(row.split()[1]) for row in rows if row.startswith("Pss:")) * 1024
        except OSError:
            continue
    return total


def pairs(folder, count):
    """Generates pairs of a random texture on planes of different disparities."""
    made = []
    for i in range(count):
        random = np.random.default_rng(i)
        fine, coarse = random.integers(0, 256, (540, 1100, 3)), random.integers(0, 256, (60, 123, 3))
        wide = (0.4 * fine + 0.6 * np.kron(coarse, np.ones((9, 9, 1)))[:540, :1100]).astype(np.uint8)
        shift = (np.arange(540) // 60 * 8 + 10)[:, None]
        columns = np.arange(960)[None]
        rows = np.arange(540)[:, None]
        paths = folder / f"left{i:03}.png", folder / f"right{i:03}.png"
        epipole.write_image(paths[0], wide[rows, columns + 40])
        epipole.write_image(paths[1], wide[rows, columns + 40 + shift])
        made.append(paths)
    return made


def loop(given, folder, depth):
    matched = []
    for i, (left, right) in enumerate(given):
        found = depth(epipole.read_image(left), epipole.read_image(right))
        np.savez(folder / f"{i}.npz", disparity=found.disparity, state=found.state)
        matched.append(found.matched_fraction)
    return min(matched)


def timed(work):
    start, before = time.monotonic(), busy()
    result = work()
    return time.monotonic() - start, busy() - before, result


def main():
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 240
    few = count // 4
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        (folder / "in").mkdir()
        (folder / "out").mkdir()
        given = pairs(folder / "in", count)
        one = [timed(lambda n=n: loop(given[:n], folder / "out", partial(epipole.depth, disparities=DISPARITIES, threads=1))) for n in (few, count)]
        matcher = epipole._native.PairDepth(disparities=DISPARITIES, threads=1)
        reused = [timed(lambda n=n: loop(given[:n], folder / "out", matcher.compute)) for n in (few, count)]
        print(f"one thread: {one[1][0]:.1f} s, at least {one[1][2]:.0%} matched")
        import ray

        ray.init(num_cpus=3, include_dashboard=False, log_to_driver=False)
        ray.data.DataContext.get_current().enable_progress_bars = False
        epipole.ray.depth(given[:2], folder / "warm", disparities=DISPARITIES, actors=2)
        two, memory = [], []

        def run(n):
            rows = epipole.ray.depth(given[:n], folder / f"ray{n}", disparities=DISPARITIES, actors=2).take_all()
            memory.append(resident())
            assert len(rows) == n and not any(row["error"] for row in rows)

        two = [timed(lambda n=n: run(n)) for n in (few, count)]
        again, _, rows = timed(lambda: epipole.ray.depth(given, folder / f"ray{count}", disparities=DISPARITIES, actors=2).take_all())
        assert all(row["skipped"] for row in rows)
        wall, cpu = one[1][0] - one[0][0], one[1][1] - one[0][1]
        more = two[1][0] - two[0][0]
        print(f"two workers: {two[1][0]:.1f} s; a second run {again:.1f} s")
        print(f"{count - few} pairs more: wall {wall / more:.2f} times as fast (limit 1.7)")
        print(f"processor time {cpu / (two[1][1] - two[0][1]):.3f} as efficient as calls of depth() (limit 0.9)")
        print(f"{(reused[1][1] - reused[0][1]) / (two[1][1] - two[0][1]):.3f} as efficient as a loop that reuses its memory, as the workers do")
        print(f"Ray's processes {max(memory) / 1e6:.0f} MB (limit 1000)")
        ray.shutdown()


if __name__ == "__main__":
    main()
