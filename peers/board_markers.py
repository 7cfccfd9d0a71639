"""OpenCV's detections on a sheet drawn by `cv board` as PNG.

    python peers/board_markers.py SHEET.png charuco COLUMNS ROWS DICTIONARY MARKER_TO_SQUARE_RATIO
    python peers/board_markers.py SHEET.png aruco-grid|aprilgrid COLUMNS ROWS DICTIONARY BORDER_CELLS

Prints the detected ids and the largest residual of the corners in pixels after a least squares fit of the board's layout by scale
and translation: the chessboard corners of a ChArUco board, the marker corners of a grid.
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


def fit_layout(corners, layout):
    """Fits the layout by scale and translation; returns the largest residual in pixels and the scale."""
    a = np.array([[x, 1, 0] for x, _ in layout] + [[y, 0, 1] for _, y in layout], float)
    b = np.concatenate([corners[:, 0], corners[:, 1]])
    solution = np.linalg.lstsq(a, b, rcond=None)[0]
    residual = (a @ solution - b).reshape(2, -1)
    return np.hypot(*residual).max(), solution[0]


if kind == "charuco":
    board = cv2.aruco.CharucoBoard((columns, rows), 1.0, float(last), dictionary)
    detector = cv2.aruco.CharucoDetector(board, cv2.aruco.CharucoParameters(), parameters)
    corners, ids, _, marker_ids = detector.detectBoard(image)
    detected = corners.reshape(-1, 2)
    layout = board.getChessboardCorners()[ids.ravel(), :2]
    print("markers", sorted(marker_ids.ravel().tolist()), "corners", len(ids))
else:
    marker_corners, ids, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(image)
    ids = ids.ravel()
    print("markers", sorted(ids.tolist()))
    # OpenCV's GridBoard numbers markers from the top left; Kalibr's AprilGrid from the bottom left, with tags rotated by 180° in OpenCV's dictionary.
    april = kind == "aprilgrid"
    unit = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
    detected, layout = [], []
    for corners, marker in zip(marker_corners, ids):
        column, row = marker % columns, marker // columns
        row = rows - 1 - row if april else row
        marker_layout = np.roll(unit, 2, axis=0) if april else unit
        detected.append(corners.reshape(4, 2))
        layout.append(marker_layout + 1.3 * np.array([column, row]))
    detected, layout = np.concatenate(detected), np.concatenate(layout)
largest, scale = fit_layout(detected, layout)
print(f"largest residual {largest:.3f} px, one unit is {scale:.4f} px")
