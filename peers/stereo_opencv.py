"""OpenCV's stereo matchers on Middlebury pairs, one JSON line per pair and matcher. usage: stereo_opencv.py DATA/stereo"""
import json, sys, time
import cv2
import numpy as np
from stereo_scenes import SCENES, errors, truth_and_mask

FOLDER = sys.argv[1]
# Seconds for which a matcher is repeated to find its fastest run, and the minimum number of repeats; the same as for ours.
SECONDS, MIN_REPEATS = 0.5, 4
cv2.setNumThreads(2)

MODES = {
    "StereoBM": None, "SGBM": cv2.STEREO_SGBM_MODE_SGBM, "HH": cv2.STEREO_SGBM_MODE_HH,
    "3WAY": cv2.STEREO_SGBM_MODE_SGBM_3WAY, "HH4": cv2.STEREO_SGBM_MODE_HH4,
}


def peak():
    # Not ru_maxrss, whose initial value is that of the parent process.
    with open("/proc/self/status") as status:
        return 1024 * next(int(line.split()[1]) for line in status if line.startswith("VmHWM"))


# Only the memory of HH at the largest size, since other runs would raise the peak.
only_memory = len(sys.argv) > 2
scenes = SCENES[-1:] if only_memory else SCENES
for scene, left_name, right_name, disparities in scenes:
    left, right = (cv2.imread(f"{FOLDER}/{scene}/{name}") for name in (left_name, right_name))
    if only_memory:
        before = peak()
        cv2.StereoSGBM_create(0, disparities, 5, 600, 2400, 1, 0, 10, 100, 32, MODES["HH"]).compute(left, right)
        print(json.dumps({"scene": scene, "mode": "HH", "bytes": peak() - before}))
        continue
    truth, mask = truth_and_mask(FOLDER, scene, lambda path: cv2.imread(path, cv2.IMREAD_UNCHANGED))
    for mode, flag in MODES.items():
        if flag is None:
            matcher = cv2.StereoBM_create(disparities, 15)
            a, b = (cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in (left, right))
        else:
            matcher = cv2.StereoSGBM_create(0, disparities, 5, 8 * 3 * 25, 32 * 3 * 25, 1, 0, 10, 100, 32, flag)
            a, b = left, right
        times = []
        begin = time.perf_counter()
        while len(times) < MIN_REPEATS or time.perf_counter() - begin < SECONDS:
            start = time.perf_counter()
            result = matcher.compute(a, b)
            times.append(time.perf_counter() - start)
        disparity = np.where(result >= 0, result / 16, np.nan)
        print(json.dumps({
            "scene": scene, "mode": mode, "seconds": min(times[1:]), **errors(disparity, truth, mask),
            "version": cv2.__version__,
        }), flush=True)
