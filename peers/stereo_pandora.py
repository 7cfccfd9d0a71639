"""CNES Pandora on Middlebury pairs, one JSON line per pair: census 5x5, semi-global matching, V fit, median, cross-check,
interpolation. usage: stereo_pandora.py DATA/stereo"""
import json, os, sys, tempfile, time
import numpy as np
import pandora
import rasterio

sys.argv, folder = sys.argv[:1] + ["."], sys.argv[1]
work = tempfile.mkdtemp()
os.makedirs(work + "/out")


def read(path):
    with rasterio.open(path) as file:
        bands = file.read().astype(np.float64)
    if len(bands) == 1:
        return bands[0]
    return np.round(0.299 * bands[0] + 0.587 * bands[1] + 0.114 * bands[2])


def grey_truth(name, scale):
    truth = read(f"{folder}/{name}") / scale
    return np.where(truth == 0, np.nan, truth)


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


def motorcycle():
    truth = np.load(f"{folder}/motorcycle/motorcycle_disp.npz")["arr_0"]
    return np.where(np.isfinite(truth), truth, np.nan), None


SCENES = [
    ("cones", "im2.png", "im6.png", 64, lambda: (grey_truth("cones/disp2.png", 4), grey_truth("cones/disp6.png", 4))),
    ("teddy", "im2.png", "im6.png", 64, lambda: (grey_truth("teddy/disp2.png", 4), None)),
    ("cloth3", "view1.png", "view5.png", 128, lambda: (grey_truth("cloth3/disp1.png", 2), grey_truth("cloth3/disp5.png", 2))),
    ("motorcycle", "motorcycle_left.png", "motorcycle_right.png", 128, motorcycle),
]
for scene, left, right, disparities, truths in SCENES:
    for side, name in (("L", left), ("R", right)):
        grey = read(f"{folder}/{scene}/{name}").astype("uint8")
        with rasterio.open(f"{work}/{side}.tif", "w", driver="GTiff", height=grey.shape[0], width=grey.shape[1], count=1,
                           dtype="uint8") as file:
            file.write(grey, 1)
    config = {
        "input": {"left": {"img": work + "/L.tif", "disp": [-disparities, 0]}, "right": {"img": work + "/R.tif"}},
        "pipeline": {
            "matching_cost": {"matching_cost_method": "census", "window_size": 5, "subpix": 1},
            "optimization": {"optimization_method": "sgm",
                             "penalty": {"penalty_method": "sgm_penalty", "P1": 4, "P2": 20}},
            "disparity": {"disparity_method": "wta", "invalid_disparity": "NaN"},
            "refinement": {"refinement_method": "vfit"}, "filter": {"filter_method": "median"},
            "validation": {"validation_method": "cross_checking_accurate", "interpolated_disparity": "sgm"},
            "filter.1": {"filter_method": "median"},
        },
    }
    with open(work + "/c.json", "w") as file:
        json.dump(config, file)
    start = time.perf_counter()
    pandora.main(work + "/c.json", work + "/out", False)
    seconds = time.perf_counter() - start
    disparity = -read(work + "/out/left_disparity.tif")
    truth, truth_right = truths()
    mask = non_occluded(truth, truth_right)
    n, error, valid = mask.sum(), np.abs(disparity - truth), np.isfinite(disparity)
    print(json.dumps({
        "scene": scene, "mode": "Pandora", "seconds": seconds, "density": float((mask & valid).sum() / n),
        "bad1": float((mask & ~(error <= 1)).sum() / n), "bad2": float((mask & ~(error <= 2)).sum() / n),
        "bad2_of_valid": float((mask & valid & ~(error <= 2)).sum() / (mask & valid).sum()), "version": pandora.__version__
        if hasattr(pandora, "__version__") else "",
    }), flush=True)
