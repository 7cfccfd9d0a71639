"""OpenCV's features. usage: features_opencv.py speed IMAGE WHAT | features_opencv.py extract N IMAGE...

speed prints a JSON line with the fastest of some warm runs on two threads. extract writes IMAGE.sift.npy and IMAGE.orb.npy: a row per
feature, by decreasing response, of x, y, scale in pixels (half the keypoint's size), angle in radians, response, and the descriptor."""
import json, os, sys, time
import cv2
import numpy as np

cv2.setNumThreads(2)


def fastest(call, repeats):
    call()
    best = float("inf")
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        best = min(best, time.perf_counter() - start)
    return best


def speed(path, what):
    gray = cv2.imread(path, cv2.IMREAD_GRAYSCALE)
    random = np.random.default_rng(1)
    # Only the arrays of this stage: other large arrays slow down OpenCV's allocations.
    sizes = [(n, d) for n, d in ((2000, 64), (8192, 128), (20000, 128)) if what.endswith(f" {n}")]
    sets = {n: [random.random((n, d), np.float32) for _ in range(2)] for n, d in sizes}
    square = random.random((4096, 4096), np.float32) if "product" in what else None
    stages = {
        "cornerHarris": (lambda: cv2.cornerHarris(gray, 3, 3, 0.04), 20),
        "goodFeaturesToTrack": (lambda: cv2.goodFeaturesToTrack(gray, 500, 0.01, 8, useHarrisDetector=True), 20),
        "goodFeaturesToTrack, Shi-Tomasi": (lambda: cv2.goodFeaturesToTrack(gray, 500, 0.01, 8), 10),
        "SIFT": (lambda: cv2.SIFT_create(2000).detectAndCompute(gray, None), 5),
        "ORB": (lambda: cv2.ORB_create(2000).detectAndCompute(gray, None), 10),
        "BFMatcher 2000": (lambda: cv2.BFMatcher(cv2.NORM_L2).knnMatch(*sets[2000], 2), 8),
        "BFMatcher 8192": (lambda: cv2.BFMatcher(cv2.NORM_L2).knnMatch(*sets[8192], 2), 1),
        "FlannBasedMatcher 20000": (lambda: cv2.FlannBasedMatcher({"algorithm": 1, "trees": 4}, {"checks": 32}).knnMatch(*sets[20000], 2), 1),
        "matrix product 4096": (lambda: square @ square, 3),
    }
    call, repeats = stages[what]
    print(json.dumps({"stage": what, "seconds": fastest(call, repeats), "version": cv2.__version__}), flush=True)


def extract(count, paths):
    for path in paths:
        gray = cv2.imread(path, cv2.IMREAD_GRAYSCALE)
        for name, detector in (("sift", cv2.SIFT_create(count)), ("orb", cv2.ORB_create(count))):
            keypoints, descriptors = detector.detectAndCompute(gray, None)
            order = sorted(range(len(keypoints)), key=lambda i: -keypoints[i].response)[:count]
            dimension = 128 if name == "sift" else 32
            rows = np.zeros((len(order), 5 + dimension), np.float32)
            for row, i in zip(rows, order):
                k = keypoints[i]
                row[:5] = k.pt[0], k.pt[1], k.size / 2, np.deg2rad(k.angle), k.response
                row[5:] = descriptors[i]
            np.save(f"{path}.{name}.npy", rows)


if sys.argv[1] == "speed":
    speed(*sys.argv[2:])
else:
    extract(int(sys.argv[2]), sys.argv[3:])
