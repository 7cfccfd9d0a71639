"""Latency of Ctrl-C at 12 Mpx: the time from SIGINT to KeyboardInterrupt, at many moments of each job.

Run on an idle machine, with the package in the release profile. Each job runs once to its end, then is interrupted at moments spread evenly over that
time. Prints the job, its duration and the five largest latencies, each with its moment, in seconds.

    python benchmarks/interrupt.py [MOMENTS [JOB...]]
"""

import os
import signal
import sys
import threading
import time

import numpy as np

import epipole


def images():
    """Returns noise, blocks of 4×4 px of noise, the latter 40 px to the left, and a color image with an orange square and its mask."""
    random = np.random.default_rng(0)
    noise = random.integers(0, 255, (3000, 4000), np.uint8)
    blocks = np.kron(random.integers(0, 255, (750, 1000), np.uint8), np.ones((4, 4), np.uint8))
    mask = np.zeros(noise.shape, bool)
    mask[1000:2000, 1500:2500] = True
    color = np.repeat(blocks[:, :, None], 3, 2)
    color[mask] = (250, 120, 10)
    return noise, blocks, np.roll(blocks, -40, 1), color, mask


def jobs():
    """Returns the jobs by name."""
    noise, blocks, shifted, color, mask = images()
    flipped = noise[:, ::-1].copy()
    model = epipole.ColorModel().fit([color[::8, ::8].copy()], [mask[::8, ::8].copy()])
    camera = epipole.Camera(4000, 3000, [[3000, 0, 2000], [0, 3000, 1500], [0, 0, 1]], [-0.2, 0.05, 1e-3, -2e-3, 0.01])
    return {
        "depth": lambda: epipole.depth(blocks, shifted, disparities=256),
        "calibrate": lambda: epipole.calibrate([noise] * 6, board=epipole.Chessboard((9, 6))),
        "fit": lambda: epipole.ColorModel().fit([color], [mask]),
        "predict": lambda: model.predict(color),
        "predict_proba": lambda: model.predict_proba(color),
        "undistort": lambda: epipole.undistort(color, camera),
        "match_features": lambda: epipole.match_features(noise, flipped),
        "reconstruct": lambda: epipole.reconstruct(noise, flipped),
        "panorama": lambda: epipole.panorama([color[:, :3000], color[:, 1000:]]),
        "sfm": lambda: epipole.sfm([color[:, :3000].copy(), color[:, 500:3500].copy(), color[:, 1000:].copy()]),
    }


def run(job, moment=None):
    """Runs a job; with a moment in seconds it is interrupted then. Returns its duration and the latency, `None` where it ended before."""
    sent = []

    def interrupt():
        sent.append(time.monotonic())
        os.kill(os.getpid(), signal.SIGINT)

    timer = threading.Timer(moment, interrupt) if moment is not None else None
    start = time.monotonic()
    try:
        try:
            if timer is not None:
                timer.start()
            job()
        except (epipole.errors.EpipoleError, ValueError, RuntimeError):
            # Some jobs refuse these images: their time until then is measured all the same.
            pass
        finally:
            if timer is not None:
                timer.cancel()
                timer.join()
        return time.monotonic() - start, None
    except KeyboardInterrupt:
        end = time.monotonic()
        return end - start, end - sent[0]


def main():
    moments = int(sys.argv[1]) if len(sys.argv) > 1 else 20
    all_jobs = jobs()
    for name in sys.argv[2:] or all_jobs:
        duration, _ = run(all_jobs[name])
        latencies = []
        for i in range(moments):
            moment = duration * (i + 0.5) / moments
            latency = run(all_jobs[name], moment)[1]
            if latency is not None:
                latencies.append((latency, moment))
        largest = ", ".join(f"{latency:.3f} at {moment:.2f}" for latency, moment in sorted(latencies, reverse=True)[:5])
        print(f"{name}: {duration:.2f} s; {len(latencies)} interrupted; {largest}", flush=True)


if __name__ == "__main__":
    main()
