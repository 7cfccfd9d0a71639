"""OpenCV's stereo matchers on Middlebury pairs, one JSON line per pair and matcher. usage: stereo_opencv.py DATA/stereo"""
import json, sys, time
import cv2
import numpy as np

FOLDER = sys.argv[1]
# Repeated for so many seconds, and so often at the least, for the fastest run; as ours are.
SECONDS, LEAST_REPEATS = 0.5, 4
cv2.setNumThreads(2)


def grey_truth(name, scale):
    truth = cv2.imread(f"{FOLDER}/{name}", cv2.IMREAD_UNCHANGED).astype(np.float32) / scale
    truth[truth == 0] = np.nan
    return truth


def non_occluded(left, right):
    mask = np.isfinite(left)
    if right is None:
        return mask
    h, w = left.shape
    ys, xs = np.mgrid[0:h, 0:w]
    xr = np.round(xs - np.nan_to_num(left)).astype(int)
    ok = mask & (xr >= 0)
    seen = np.full_like(left, np.nan)
    seen[ok] = right[ys[ok], xr[ok]]
    return ok & (np.abs(seen - left) <= 1)


SCENES = [
    ("cones", "im2.png", "im6.png", 64, lambda: (grey_truth("cones/disp2.png", 4), grey_truth("cones/disp6.png", 4))),
    ("teddy", "im2.png", "im6.png", 64, lambda: (grey_truth("teddy/disp2.png", 4), None)),
    ("cloth3", "view1.png", "view5.png", 128, lambda: (grey_truth("cloth3/disp1.png", 2), grey_truth("cloth3/disp5.png", 2))),
    ("motorcycle", "motorcycle_left.png", "motorcycle_right.png", 128,
     lambda: (np.load(f"{FOLDER}/motorcycle/motorcycle_disp.npz")["arr_0"], None)),
]
MODES = {
    "StereoBM": None, "SGBM": cv2.STEREO_SGBM_MODE_SGBM, "HH": cv2.STEREO_SGBM_MODE_HH,
    "3WAY": cv2.STEREO_SGBM_MODE_SGBM_3WAY, "HH4": cv2.STEREO_SGBM_MODE_HH4,
}


def peak():
    # Not ru_maxrss, which starts at what the program that started this one holds.
    with open("/proc/self/status") as status:
        return 1024 * next(int(line.split()[1]) for line in status if line.startswith("VmHWM"))


# The memory of HH at the largest size, before anything else has raised the peak.
only_memory = len(sys.argv) > 2
scenes = SCENES[-1:] if only_memory else SCENES
for scene, left_name, right_name, disparities, truths in scenes:
    left, right = (cv2.imread(f"{FOLDER}/{scene}/{name}") for name in (left_name, right_name))
    if only_memory:
        before = peak()
        cv2.StereoSGBM_create(0, disparities, 5, 600, 2400, 1, 0, 10, 100, 32, MODES["HH"]).compute(left, right)
        print(json.dumps({"scene": scene, "mode": "HH", "bytes": peak() - before}))
        continue
    truth, truth_right = truths()
    mask = non_occluded(truth, truth_right)
    for mode, flag in MODES.items():
        if flag is None:
            matcher = cv2.StereoBM_create(disparities, 15)
            a, b = (cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in (left, right))
        else:
            matcher = cv2.StereoSGBM_create(0, disparities, 5, 8 * 3 * 25, 32 * 3 * 25, 1, 0, 10, 100, 32, flag)
            a, b = left, right
        times = []
        begin = time.perf_counter()
        while len(times) < LEAST_REPEATS or time.perf_counter() - begin < SECONDS:
            start = time.perf_counter()
            result = matcher.compute(a, b)
            times.append(time.perf_counter() - start)
        disparity = result.astype(np.float32) / 16
        valid = disparity >= 0
        error = np.abs(disparity - truth)
        n = mask.sum()
        print(json.dumps({
            "scene": scene, "mode": mode, "seconds": min(times[1:]), "density": float((mask & valid).sum() / n),
            "bad1": float((mask & (~valid | (error > 1))).sum() / n), "bad2": float((mask & (~valid | (error > 2))).sum() / n),
            "bad2_of_valid": float((mask & valid & (error > 2)).sum() / (mask & valid).sum()),
            "version": cv2.__version__,
        }), flush=True)
