"""CNES Pandora on Middlebury pairs, one JSON line per pair: census 5x5, semi-global matching, V fit, median, cross-check,
interpolation. usage: stereo_pandora.py DATA/stereo"""
import json, os, sys, tempfile, time
import numpy as np
import pandora
import rasterio
from stereo_scenes import SCENES, errors, truth_and_mask

# Pandora's plug-ins parse the arguments, so they are cleared.
arguments, sys.argv = sys.argv, sys.argv[:1] + ["."]
work = tempfile.mkdtemp()
os.makedirs(work + "/out")


def read(path):
    with rasterio.open(path) as file:
        bands = file.read().astype(np.float64)
    if len(bands) == 1:
        return bands[0]
    return np.round(0.299 * bands[0] + 0.587 * bands[1] + 0.114 * bands[2])


def disparity(left, right, disparities, first=0):
    """Returns the disparities of a pair, NaN if invalid, and the seconds of the whole run."""
    for side, path in (("L", left), ("R", right)):
        gray = read(path).astype("uint8")
        with rasterio.open(f"{work}/{side}.tif", "w", driver="GTiff", height=gray.shape[0], width=gray.shape[1], count=1,
                           dtype="uint8") as file:
            file.write(gray, 1)
    config = {
        "input": {"left": {"img": work + "/L.tif", "disp": [-(first + disparities), -first]},
                  "right": {"img": work + "/R.tif"}},
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
    return -read(work + "/out/left_disparity.tif"), seconds


if __name__ == "__main__":
    folder = arguments[1]
    for scene, left, right, disparities in SCENES:
        result, seconds = disparity(f"{folder}/{scene}/{left}", f"{folder}/{scene}/{right}", disparities)
        truth, mask = truth_and_mask(folder, scene, read)
        print(json.dumps({
            "scene": scene, "mode": "Pandora", "seconds": seconds, **errors(result, truth, mask),
            "version": getattr(pandora, "__version__", ""),
        }), flush=True)
