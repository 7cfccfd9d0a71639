"""OpenCV's matchers and Pandora on every pair with ground truth, one JSON line per pair and matcher. usage: stereo_groups.py DATA

A line has bad-2.0 as a fraction (error above 2 px or no disparity): of the pixels visible in both views (`visible`) and of all with
ground truth (`all`)."""
import json, sys
from pathlib import Path
import cv2
import numpy as np
from stereo_scenes import SCENES, truth_and_mask

# Read before the import of stereo_pandora, which clears the arguments.
DATA = Path(sys.argv[1])
try:
    from stereo_pandora import disparity as pandora
except ImportError:
    pandora = None

cv2.setNumThreads(2)
MODES = {"SGBM": cv2.STEREO_SGBM_MODE_SGBM, "HH": cv2.STEREO_SGBM_MODE_HH, "3WAY": cv2.STEREO_SGBM_MODE_SGBM_3WAY,
         "HH4": cv2.STEREO_SGBM_MODE_HH4}


def pairs():
    """Yields name, photographs, number of disparities, smallest disparity, ground truth and mask of the visible pixels."""
    read = lambda path: cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    for name, left, right, disparities in SCENES:
        folder = DATA / "stereo"
        yield name, folder / name / left, folder / name / right, disparities, 0, *truth_and_mask(folder, name, read)
    for scene in sorted((DATA / "stereo-more").glob("*/scene.json")):
        info, folder = json.loads(scene.read_text()), scene.parent
        if (folder / "truth.png").exists():
            truth = read(folder / "truth.png").astype(np.float64) / 256
            truth[truth == 0] = np.nan
        else:
            truth = next(iter(np.load(folder / "truth.npz").values())).astype(np.float64)
        visible = np.isfinite(truth)
        if (folder / "mask.png").exists():
            visible &= cv2.imread(str(folder / "mask.png"), cv2.IMREAD_GRAYSCALE) > 127
        yield folder.name, folder / "left.png", folder / "right.png", info["disparities"], info["min"], truth, visible


def main():
    for name, left, right, disparities, first, truth, visible in pairs():
        a, b = cv2.imread(str(left)), cv2.imread(str(right))
        disparities_by_mode = {}
        for mode, flag in MODES.items():
            # OpenCV requires a multiple of 16.
            count = -(-disparities // 16) * 16
            sgm = cv2.StereoSGBM_create(first, count, 5, 8 * 3 * 25, 32 * 3 * 25, 1, 0, 10, 100, 32, flag)
            result = sgm.compute(a, b)
            disparities_by_mode[mode] = np.where(result >= 16 * first, result / 16, np.nan)
        if pandora:
            disparities_by_mode["Pandora"] = pandora(str(left), str(right), disparities, first)[0]
        for mode, disparity in disparities_by_mode.items():
            bad = ~(np.abs(disparity - truth) <= 2)
            known = np.isfinite(truth)
            print(json.dumps({"scene": name, "mode": mode, "visible": float(bad[visible].mean()), "all": float(bad[known].mean())}), flush=True)


main()
