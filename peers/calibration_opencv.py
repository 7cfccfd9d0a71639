"""OpenCV's calibration, on one thread unless noted; prints JSON lines. usage:
calibration_opencv.py pairs FOLDER           both detectors on leftNN.jpg, rightNN.jpg with 9x6 corners: detections, errors, the rig
calibration_opencv.py wide FOLDER [OUT]      both detectors on photographs with 8x6 corners, with 5 and 8 distortion coefficients; the classic corners are written to OUT as a vnlog
calibration_opencv.py mrcal FOLDER VNLOG     mrcal, if installed, on those corners; hold-out with poses by solvePnP
calibration_opencv.py corners FOLDER         both detectors on the PNG files, 9x6 corners (only the classic one on names with the prefix none)
calibration_opencv.py markers FOLDER KIND C R DICTIONARY LAST  the marker board in the PNG files; LAST: marker to square ratio of a charuco, else border cells
calibration_opencv.py solve FILE C R W H     calibrateCamera of views of C x R corners, a line of x and y each
calibration_opencv.py remap W H OUT          a pair undistorted with fixed-point maps, on one and two threads; inputs and results are in OUT
"""
import ast, glob, json, os, re, shutil, subprocess, sys, tempfile, time
import cv2
import numpy as np

cv2.setNumThreads(1)
VERSION = cv2.__version__
TERM = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 0.001)


def classic(gray, size):
    found, corners = cv2.findChessboardCorners(gray, size)
    return cv2.cornerSubPix(gray, corners, (5, 5), (-1, -1), TERM) if found else None


def sector(gray, size):
    found, corners = cv2.findChessboardCornersSB(gray, size)
    return corners if found else None


DETECTORS = {"classic": classic, "sector-based": sector}


def detect_all(paths, size, detector):
    """Returns corners or None for each photograph, the processor seconds of detection without reading, and the image size."""
    out, seconds = [], 0.0
    for path in paths:
        gray = cv2.imread(path, cv2.IMREAD_GRAYSCALE)
        start = time.thread_time()
        out.append(DETECTORS[detector](gray, size))
        seconds += time.thread_time() - start
    return out, seconds, gray.shape[::-1]


def board(size):
    points = np.zeros((size[0] * size[1], 3), np.float32)
    points[:, :2] = np.mgrid[0:size[0], 0:size[1]].T.reshape(-1, 2)
    return points


def holdout(points, views, solve):
    """Returns the hold-out RMS in pixels: intrinsics from one half of the views, poses of the other half by PnP, for both halves. `solve`
    returns matrix and distortion from a half."""
    squares, count = 0.0, 0
    for half in (0, 1):
        k, d = solve(half)
        for corners in views[1 - half::2]:
            _, r, t = cv2.solvePnP(points, corners, k, d)
            r, t = cv2.solvePnPRefineLM(points, corners, k, d, r, t)
            off = cv2.projectPoints(points, r, t, k, d)[0].reshape(-1, 2) - corners.reshape(-1, 2)
            squares, count = squares + float((off ** 2).sum()), count + len(off)
    return (squares / count) ** 0.5


def opencv(points, views, size, flags):
    def solve(half):
        train = views[half::2]
        return cv2.calibrateCamera([points] * len(train), train, size, None, None, flags=flags)[1:3]

    return solve


def pairs(folder):
    size = (9, 6)
    points = board(size)
    lefts = sorted(glob.glob(f"{folder}/left*.jpg"))
    rights = [os.path.join(folder, os.path.basename(p).replace("left", "right")) for p in lefts]
    for detector in DETECTORS:
        a, s0, shape = detect_all(lefts, size, detector)
        b, s1, _ = detect_all(rights, size, detector)
        both = [i for i in range(len(a)) if a[i] is not None and b[i] is not None]
        a, b = [a[i] for i in both], [b[i] for i in both]
        many = [points] * len(both)
        e1, k1, d1, _, _ = cv2.calibrateCamera(many, a, shape, None, None)
        e2, k2, d2, _, _ = cv2.calibrateCamera(many, b, shape, None, None)
        e, k1, d1, k2, d2, r, t, _, _ = cv2.stereoCalibrate(many, a, b, k1, d1, k2, d2, shape, flags=cv2.CALIB_USE_INTRINSIC_GUESS)
        r1, r2, p1, p2, *_ = cv2.stereoRectify(k1, d1, k2, d2, shape, r, t, alpha=0)
        rows = lambda c, k, d, r, p: cv2.undistortPoints(c, k, d, R=r, P=p)[:, 0, 1]
        dy = np.concatenate([np.abs(rows(l, k1, d1, r1, p1) - rows(r_, k2, d2, r2, p2)) for l, r_ in zip(a, b)])
        print(json.dumps({"detector": detector, "found": len(both), "of": len(lefts), "seconds": s0 + s1, "rms": [e1, e2], "stereo": e,
                          "holdout": [holdout(points, c, opencv(points, c, shape, 0)) for c in (a, b)],
                          "baseline": float(np.linalg.norm(t)), "dy": [float(dy.mean()), float(dy.max())], "version": VERSION}), flush=True)


def wide(folder, out=None):
    size = (8, 6)
    points = board(size)
    paths = sorted(glob.glob(f"{folder}/*.jpg"))
    for detector in DETECTORS:
        all_corners, seconds, shape = detect_all(paths, size, detector)
        views = [c for c in all_corners if c is not None]
        if out and detector == "classic":
            with open(out, "w") as file:
                file.write("# filename x y level\n")
                for path, corners in zip(paths, all_corners):
                    rows = [] if corners is None else corners.reshape(-1, 2).tolist()
                    file.writelines(f"{os.path.basename(path)} {x!r} {y!r} 0\n" for x, y in rows)
                    file.write("" if rows else f"{os.path.basename(path)} - - -\n")
        for coefficients, flags in ((5, 0), (8, cv2.CALIB_RATIONAL_MODEL)):
            rms = cv2.calibrateCamera([points] * len(views), views, shape, None, None, flags=flags)[0]
            print(json.dumps({"detector": detector, "found": len(views), "of": len(paths), "seconds": seconds, "coefficients": coefficients, "rms": rms,
                              "holdout": holdout(points, views, opencv(points, views, shape, flags)), "version": VERSION}), flush=True)


def mrcal(folder, vnlog):
    program = shutil.which("mrcal-calibrate-cameras")
    if program is None:
        return
    rows = {}
    for line in open(vnlog).read().splitlines()[1:]:
        name, x, y, _ = line.split()
        rows.setdefault(name, [])
        if x != "-":
            rows[name].append((x, y))
    names = [n for n in rows if rows[n]]
    points, views = board((8, 6)), [np.array(rows[n], np.float32).reshape(-1, 1, 2) for n in names]
    shape = cv2.imread(f"{folder}/{names[0]}", cv2.IMREAD_GRAYSCALE).shape

    def solve(of, model):
        with tempfile.TemporaryDirectory() as out:
            with open(f"{out}/corners.vnl", "w") as file:
                file.write("# filename x y level\n" + "".join(f"{n} {x} {y} 0\n" for n in of for x, y in rows[n]))
            arguments = ["--corners-cache", f"{out}/corners.vnl", "--lensmodel", model, "--focal", str(0.9 * shape[1]), "--object-spacing", "1",
                         "--object-width-n", "8", "--object-height-n", "6", "--imagersize", str(shape[1]), str(shape[0]), "--outdir", out]
            text = subprocess.run([program, *arguments, "*.jpg"], stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
                                  text=True, cwd=folder, check=True).stdout
            values = re.search(r"'intrinsics': (\[.*?\])", open(f"{out}/camera-0.cameramodel").read()).group(1)
        fx, fy, cx, cy, *d = ast.literal_eval(values)
        # RMS per coordinate.
        rms = float(re.findall(r"## RMS error: ([0-9.]+)", text)[-1])
        return rms, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.array(d), int(re.search(r"Noutliers: (\d+)", text).group(1))

    for model, coefficients in (("LENSMODEL_OPENCV5", 5), ("LENSMODEL_OPENCV8", 8)):
        rms, _, _, outliers = solve(names, model)
        holdout_rms = holdout(points, views, lambda half: solve(names[half::2], model)[1:3])
        print(json.dumps({"detector": "mrcal", "found": len(names), "of": len(rows), "seconds": 0.0, "coefficients": coefficients, "rms": rms,
                          "outliers": outliers, "holdout": holdout_rms, "version": "mrcal"}), flush=True)


def corners(folder):
    for path in sorted(glob.glob(f"{folder}/*.png")):
        gray = cv2.imread(path, cv2.IMREAD_GRAYSCALE)
        for detector, call in DETECTORS.items():
            if detector != "classic" and os.path.basename(path).startswith("none"):
                continue
            start = time.thread_time()
            found = call(gray, (9, 6))
            seconds = time.thread_time() - start
            found = None if found is None else found.reshape(-1, 2).tolist()
            print(json.dumps({"image": os.path.basename(path), "detector": detector, "seconds": seconds, "corners": found}), flush=True)


def markers(folder, kind, columns, rows, name, last):
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    if kind == "charuco":
        board = cv2.aruco.CharucoBoard((columns, rows), 1.0, float(last), dictionary)
        charuco = cv2.aruco.CharucoDetector(board, cv2.aruco.CharucoParameters(), parameters)
        detect = lambda gray: charuco.detectBoard(gray)[0]
    else:
        parameters.markerBorderBits = int(last)
        grid = cv2.aruco.ArucoDetector(dictionary, parameters)
        # Markers of the dictionary that are not on the board are ignored.
        detect = lambda gray: [c for c, i in zip(*grid.detectMarkers(gray)[:2]) if i < columns * rows]
    for path in sorted(glob.glob(f"{folder}/*.png")):
        gray = cv2.imread(path, cv2.IMREAD_GRAYSCALE)
        start = time.thread_time()
        found = detect(gray)
        seconds = time.thread_time() - start
        found = [] if found is None or len(found) == 0 else np.concatenate([np.reshape(c, (-1, 2)) for c in found]).tolist()
        print(json.dumps({"image": os.path.basename(path), "seconds": seconds, "corners": found}), flush=True)


def solve(file, columns, rows, width, height):
    n = columns * rows
    views = np.loadtxt(file, np.float32).reshape(-1, n, 1, 2)
    points = board((columns, rows)) * 30
    best = float("inf")
    for _ in range(5):
        start = time.thread_time()
        rms, k, *_ = cv2.calibrateCamera([points] * len(views), list(views), (width, height), None, None)
        best = min(best, time.thread_time() - start)
    print(json.dumps({"seconds": best, "rms": rms, "fx": float(k[0, 0]), "version": VERSION}), flush=True)


def remap(width, height, out):
    # The camera of xtask/src/peers/calibration_undistort.rs.
    scale = width / 1280
    k = np.array([[900 * scale, 0, 650 * scale], [0, 902 * scale, 390 * scale], [0, 0, 1]])
    d = np.array([-0.3, 0.1, 1e-3, -5e-4, 0.0])
    rotation = cv2.Rodrigues(np.array([0.01, 0.02, 0.005]))[0]
    # Separate maps for the two cameras, as in a rig.
    maps = [cv2.initUndistortRectifyMap(k, d, rotation, k, (width, height), cv2.CV_16SC2) for _ in range(2)]
    for channels, name in ((1, "gray"), (3, "rgb")):
        shape = (height, width) if channels == 1 else (height, width, 3)
        pair = [np.fromfile(f"{out}/{name}{i}.bytes", np.uint8).reshape(shape) for i in (0, 1)]
        results = [np.empty_like(p) for p in pair]
        for threads in (1, 2):
            cv2.setNumThreads(threads)
            best = float("inf")
            for _ in range(100):
                start = time.perf_counter()
                for image, result, map_pair in zip(pair, results, maps):
                    cv2.remap(image, *map_pair, cv2.INTER_LINEAR, dst=result)
                best = min(best, time.perf_counter() - start)
            print(json.dumps({"kind": name, "threads": threads, "seconds": best, "version": VERSION}), flush=True)
        results[0].tofile(f"{out}/{name}.result")


command, *arguments = sys.argv[1:]
calls = {"pairs": pairs, "wide": wide, "mrcal": mrcal, "corners": corners, "markers": markers, "solve": solve, "remap": remap}
calls[command](*(int(a) if a.isdigit() else a for a in arguments))
