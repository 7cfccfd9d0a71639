"""OpenCV's matchers and Pandora on every pair with truth, one JSON line per pair and matcher. usage: stereo_groups.py DATA

A line holds the shares of pixels that are off by more than 2 px or have no disparity: of those that both photographs see
(`seen`) and of all with truth (`all`)."""
import json, sys
from pathlib import Path
import cv2
import numpy as np
from stereo_scenes import SCENES, truth_and_mask

# Before Pandora takes the arguments away.
DATA = Path(sys.argv[1])
try:
    from stereo_pandora import disparity as pandora
except ImportError:
    pandora = None

cv2.setNumThreads(2)
MODES = {"SGBM": cv2.STEREO_SGBM_MODE_SGBM, "HH": cv2.STEREO_SGBM_MODE_HH, "3WAY": cv2.STEREO_SGBM_MODE_SGBM_3WAY,
         "HH4": cv2.STEREO_SGBM_MODE_HH4}


def pairs():
    """Name, photographs, number of disparities and the smallest, truth, and what both see."""
    read = lambda path: cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    for name, left, right, disparities in SCENES:
        folder = DATA / "stereo"
        yield name, folder / name / left, folder / name / right, disparities, 0, *truth_and_mask(folder, name, read)
    for scene in sorted((DATA / "stereo-more").glob("*/scene.json")):
        about, folder = json.loads(scene.read_text()), scene.parent
        if (folder / "truth.png").exists():
            truth = read(folder / "truth.png").astype(np.float64) / 256
            truth[truth == 0] = np.nan
        else:
            truth = next(iter(np.load(folder / "truth.npz").values())).astype(np.float64)
        seen = np.isfinite(truth)
        if (folder / "mask.png").exists():
            seen &= cv2.imread(str(folder / "mask.png"), cv2.IMREAD_GRAYSCALE) > 127
        yield folder.name, folder / "left.png", folder / "right.png", about["disparities"], about["min"], truth, seen


def main():
    for name, left, right, disparities, first, truth, seen in pairs():
        a, b = cv2.imread(str(left)), cv2.imread(str(right))
        found = {}
        for mode, flag in MODES.items():
            # OpenCV takes multiples of 16.
            count = -(-disparities // 16) * 16
            sgm = cv2.StereoSGBM_create(first, count, 5, 8 * 3 * 25, 32 * 3 * 25, 1, 0, 10, 100, 32, flag)
            result = sgm.compute(a, b)
            found[mode] = np.where(result >= 16 * first, result / 16, np.nan)
        if pandora:
            found["Pandora"] = pandora(str(left), str(right), disparities, first)[0]
        for mode, disparity in found.items():
            wrong = ~(np.abs(disparity - truth) <= 2)
            known = np.isfinite(truth)
            print(json.dumps({"scene": name, "mode": mode, "seen": float(wrong[seen].mean()), "all": float(wrong[known].mean())}), flush=True)


main()
