"""The Middlebury pairs of the stereo benchmark, the mask of their evaluated pixels, and the error metrics."""
import numpy as np

# Name, left and right photograph, disparities.
SCENES = [
    ("cones", "im2.png", "im6.png", 64),
    ("teddy", "im2.png", "im6.png", 64),
    ("cloth3", "view1.png", "view5.png", 128),
    ("motorcycle", "motorcycle_left.png", "motorcycle_right.png", 128),
]
# Files of the left and right ground truth of a scene, and the scale of their disparities; 0 is unknown.
TRUTHS = {"cones": (["disp2.png", "disp6.png"], 4), "teddy": (["disp2.png"], 4), "cloth3": (["disp1.png", "disp5.png"], 2)}


def truth_and_mask(folder, scene, read):
    """Returns the true disparities and the mask of the evaluated pixels: those visible in both views if the right view has ground
    truth, else all with ground truth. `read` reads a gray image."""
    if scene == "motorcycle":
        left = np.load(f"{folder}/motorcycle/motorcycle_disp.npz")["arr_0"]
        return left, np.isfinite(left)
    names, scale = TRUTHS[scene]
    truths = [read(f"{folder}/{scene}/{name}").astype(np.float64) / scale for name in names]
    left, *right = [np.where(truth == 0, np.nan, truth) for truth in truths]
    mask = np.isfinite(left)
    if not right:
        return left, mask
    h, w = left.shape
    ys, xs = np.mgrid[0:h, 0:w]
    xr = np.round(xs - np.nan_to_num(left)).astype(int)
    ok = mask & (xr >= 0)
    right_at_match = np.full_like(left, np.nan)
    right_at_match[ok] = right[0][ys[ok], xr[ok]]
    return left, ok & (np.abs(right_at_match - left) <= 1)


def errors(disparity, truth, mask):
    """Returns density and bad pixel fractions over `mask`; a missing disparity is NaN and counts as bad."""
    n, error, valid = mask.sum(), np.abs(disparity - truth), np.isfinite(disparity)
    return {
        "density": float((mask & valid).sum() / n),
        "bad1": float((mask & ~(error <= 1)).sum() / n), "bad2": float((mask & ~(error <= 2)).sum() / n),
        "bad2_of_valid": float((mask & valid & ~(error <= 2)).sum() / (mask & valid).sum()),
    }
