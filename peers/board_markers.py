"""What OpenCV's detectors see on a sheet that `cv board` drew as PNG.

    python peers/board_markers.py SHEET.png charuco COLUMNS ROWS DICTIONARY SHARE_OF_MARKER
    python peers/board_markers.py SHEET.png aruco-grid|aprilgrid COLUMNS ROWS DICTIONARY CELLS_OF_FRAME

Prints the ids that were read, and how far the corners are from the regular layout that a least squares fit of a scale and a
shift gives, in pixels: of a ChArUco board the chessboard corners, of a grid the corners of the markers.
"""

import sys

import cv2
import numpy as np

path, kind, columns, rows, name, last = sys.argv[1:7]
columns, rows = int(columns), int(rows)
image = cv2.imread(path, cv2.IMREAD_GRAYSCALE)
names = {"36h11": "APRILTAG_36h11", "aruco-original": "ARUCO_ORIGINAL"}
dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, "DICT_" + names.get(name, name.upper())))
parameters = cv2.aruco.DetectorParameters()
parameters.markerBorderBits = 1 if kind == "charuco" else int(last)
parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX


def off(seen, places):
    """Largest distance from a scaled and shifted layout, and the scale."""
    a = np.array([[x, 1, 0] for x, _ in places] + [[y, 0, 1] for _, y in places], float)
    b = np.concatenate([seen[:, 0], seen[:, 1]])
    solution = np.linalg.lstsq(a, b, rcond=None)[0]
    residual = (a @ solution - b).reshape(2, -1)
    return np.hypot(*residual).max(), solution[0]


if kind == "charuco":
    board = cv2.aruco.CharucoBoard((columns, rows), 1.0, float(last), dictionary)
    detector = cv2.aruco.CharucoDetector(board, cv2.aruco.CharucoParameters(), parameters)
    corners, ids, _, marker_ids = detector.detectBoard(image)
    seen = corners.reshape(-1, 2)
    places = board.getChessboardCorners()[ids.ravel(), :2]
    print("markers", sorted(marker_ids.ravel().tolist()), "corners", len(ids))
else:
    marker_corners, ids, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(image)
    ids = ids.ravel()
    print("markers", sorted(ids.tolist()))
    # OpenCV's GridBoard counts from the top left; Kalibr's AprilGrid from the bottom left, with tags that stand upside down in OpenCV's dictionary.
    april = kind == "aprilgrid"
    unit = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
    seen, places = [], []
    for corners, marker in zip(marker_corners, ids):
        column, row = marker % columns, marker // columns
        row = rows - 1 - row if april else row
        own = np.roll(unit, 2, axis=0) if april else unit
        seen.append(corners.reshape(4, 2))
        places.append(own + 1.3 * np.array([column, row]))
    seen, places = np.concatenate(seen), np.concatenate(places)
largest, scale = off(seen, places)
print(f"largest distance from the layout {largest:.3f} px, one unit is {scale:.4f} px")
