"""Peers on annotated matches and on generated relative poses, one JSON line per method and pair (or kind of problem).
usage: geometry_peers.py DATA/homography DATA/fundamental PROBLEMS.bin"""
import glob, json, os, struct, sys, time
import cv2
import numpy as np
import poselib
import pycolmap

try:
    import pydegensac
except ImportError:
    pydegensac = None
REPEATS = 5
cv2.setNumThreads(2)


def load(path):
    rows = np.array([[float(v) for v in line.split()[:7]] for line in open(path) if len(line.split()) == 7])
    return rows[:, :2].copy(), rows[:, 3:5].copy(), rows[:, 6] > 0


def error_h(h, x, y):
    def one_way(h, x, y):
        q = np.c_[x, np.ones(len(x))] @ h.T
        return ((q[:, :2] / q[:, 2:] - y) ** 2).sum(1)
    return np.sqrt(np.mean((one_way(h, x, y) + one_way(np.linalg.inv(h), y, x)) / 2))


def error_f(f, x, y):
    a, b = np.c_[x, np.ones(len(x))], np.c_[y, np.ones(len(y))]
    l, m = a @ f.T, b @ f
    return np.sqrt(np.mean((b * l).sum(1) ** 2 / (l[:, 0] ** 2 + l[:, 1] ** 2 + m[:, 0] ** 2 + m[:, 1] ** 2)))


def usac_h(flag):
    return lambda x, y: cv2.findHomography(x, y, flag, 3.0, maxIters=5000, confidence=0.999)[0]


def usac_f(flag):
    return lambda x, y: cv2.findFundamentalMat(x, y, flag, 1.0, 0.999, 5000)[0]


def colmap(estimate, key, error):
    def run(x, y):
        found = estimate(x, y, pycolmap.RANSACOptions(max_error=error))
        return found[key] if found else None
    return run


FLAGS = {"OpenCV RANSAC": cv2.RANSAC, "OpenCV USAC_DEFAULT": cv2.USAC_DEFAULT, "OpenCV USAC_MAGSAC": cv2.USAC_MAGSAC,
         "OpenCV USAC_ACCURATE": cv2.USAC_ACCURATE}
H = {name: usac_h(flag) for name, flag in FLAGS.items()}
F = {name: usac_f(flag) for name, flag in FLAGS.items()}
H["PoseLib"] = lambda x, y: poselib.estimate_homography(x, y, {"max_reproj_error": 3.0})[0]
F["PoseLib"] = lambda x, y: poselib.estimate_fundamental(x, y, {"max_epipolar_error": 1.0})[0]
H["COLMAP"] = colmap(pycolmap.estimate_homography_matrix, "H", 3.0)
F["COLMAP"] = colmap(pycolmap.estimate_fundamental_matrix, "F", 1.0)
if pydegensac is not None:
    H["DEGENSAC"] = lambda x, y: pydegensac.findHomography(x, y, 3.0, 0.999, 5000)[0]
    F["DEGENSAC"] = lambda x, y: pydegensac.findFundamentalMatrix(x, y, 1.0, 0.999, 5000)[0]
VERSIONS = {"OpenCV": cv2.__version__, "PoseLib": getattr(poselib, "__version__", ""), "COLMAP": pycolmap.__version__}
print(json.dumps({"versions": VERSIONS}))

for kind, folder, methods, error in (("H", sys.argv[1], H, error_h), ("F", sys.argv[2], F, error_f)):
    for path in sorted(glob.glob(folder + "/*_pts.txt")):
        if not os.path.exists(path.replace("_pts", "_model")):
            continue
        x, y, checked = load(path)
        a, b = np.ascontiguousarray(x[~checked]), np.ascontiguousarray(y[~checked])
        for name, method in methods.items():
            times, residual = [], float("inf")
            for _ in range(REPEATS):
                start = time.perf_counter()
                try:
                    model = method(a, b)
                except Exception:  # an exception counts as a failure on this pair
                    model = None
                times.append(time.perf_counter() - start)
            if model is not None and np.asarray(model).shape == (3, 3):
                residual = float(error(np.asarray(model), x[checked], y[checked]))
            print(json.dumps({"kind": kind, "pair": os.path.basename(path)[:-8], "method": name,
                              "error": residual if np.isfinite(residual) else 1e9, "seconds": float(np.median(times))}), flush=True)

# Each problem: kind, matches, rotation (9), translation (3), then x1 y1 x2 y2 in pixels, all f64.
data = open(sys.argv[3], "rb").read()
focal, width, height, threshold, at = *struct.unpack_from("<4d", data, 0), 32
camera = {"model": "PINHOLE", "width": int(width), "height": int(height),
          "params": [focal, focal, width / 2 - 0.5, height / 2 - 0.5]}
while at < len(data):
    kind, n = (int(v) for v in struct.unpack_from("<2d", data, at))
    truth = np.frombuffer(data, np.float64, 12, at + 16)
    m = np.frombuffer(data, np.float64, 4 * n, at + 112).reshape(n, 4)
    at += 112 + 32 * n
    start = time.perf_counter()
    pose, _ = poselib.estimate_relative_pose(m[:, :2], m[:, 2:], camera, camera, {"max_epipolar_error": threshold}, {})
    seconds = time.perf_counter() - start
    cosine = (np.trace(pose.R.T @ truth[:9].reshape(3, 3)) - 1) / 2
    t = pose.t / max(np.linalg.norm(pose.t), 1e-12)
    pose_error = max(np.degrees(np.arccos(np.clip(cosine, -1, 1))), np.degrees(np.arccos(np.clip(t @ truth[9:], -1, 1))))
    print(json.dumps({"kind": str(kind), "pair": "", "method": "PoseLib", "error": float(pose_error) if np.isfinite(pose_error) else 180.0,
                      "seconds": seconds}), flush=True)
