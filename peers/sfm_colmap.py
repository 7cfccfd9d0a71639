"""COLMAP through pycolmap, on the processor: photographs of a folder to models as text; one JSON line.
usage: sfm_colmap.py IMAGES OUT THREADS [K.txt]

K.txt: 3x3, the center of the top-left pixel at (0, 0); the camera is then PINHOLE and stays as it is. Without it: one
SIMPLE_RADIAL camera, its focal length from EXIF or 1.2 times the larger side, which is adjusted.
Every stage is measured apart: `seconds` wall, `cpu` of all threads, `peak` resident bytes while it ran."""
import json, os, shutil, sys, time

threads = int(sys.argv[3])
os.environ["OMP_NUM_THREADS"] = str(threads)
import numpy as np, pycolmap

images, out, k = sys.argv[1], sys.argv[2], sys.argv[4] if len(sys.argv) > 4 else None
database = os.path.join(out, "database.db")
stages, load = [], os.getloadavg()[0]


def stage(name, call):
    with open("/proc/self/clear_refs", "w") as f:
        f.write("5")  # the peak counts from here on
    wall, cpu = time.perf_counter(), time.process_time()
    value = call()
    row = {"name": name, "seconds": time.perf_counter() - wall, "cpu": time.process_time() - cpu}
    with open("/proc/self/status") as f:
        row["peak"] = next(int(line.split()[1]) * 1024 for line in f if line.startswith("VmHWM"))
    stages.append(row)
    return value


def keep(mapper, models):
    folder = os.path.join(out, mapper)
    os.makedirs(folder, exist_ok=True)
    if models:
        max(models.values(), key=lambda m: m.num_reg_images()).write_text(folder)


pycolmap.logging.minloglevel = 2
pycolmap.set_random_seed(0)
os.makedirs(out, exist_ok=True)
reader = pycolmap.ImageReaderOptions()
if k:
    m = np.loadtxt(k)
    reader.camera_model = "PINHOLE"
    reader.camera_params = ",".join(repr(float(v)) for v in (m[0, 0], m[1, 1], m[0, 2] + 0.5, m[1, 2] + 0.5))
extraction = pycolmap.FeatureExtractionOptions()
extraction.num_threads, extraction.use_gpu = threads, False
cpu = {"device": pycolmap.Device.cpu}
stage("extract", lambda: pycolmap.extract_features(
    database, images, camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reader, extraction_options=extraction, **cpu))
matching = pycolmap.FeatureMatchingOptions()
matching.num_threads, matching.use_gpu, matching.skip_geometric_verification = threads, False, True
stage("match", lambda: pycolmap.match_exhaustive(database, matching_options=matching, **cpu))
two_view, verifier = pycolmap.TwoViewGeometryOptions(), pycolmap.GeometricVerifierOptions()
two_view.ransac.random_seed, verifier.num_threads = 0, threads
stage("verify", lambda: pycolmap.geometric_verification(
    database, verifier_options=verifier, two_view_geometry_options=two_view))

work = os.path.join(out, "work")
os.makedirs(work)
options = pycolmap.IncrementalPipelineOptions()
options.num_threads = options.mapper.num_threads = threads
options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = 0
options.ba_refine_focal_length = options.ba_refine_extra_params = not k
keep("incremental", stage("incremental", lambda: pycolmap.incremental_mapping(database, images, work, options=options)))

if not k:
    calibration = pycolmap.ViewGraphCalibrationOptions()
    calibration.random_seed = 0
    stage("calibrate", lambda: pycolmap.calibrate_view_graph(database, options=calibration))
options = pycolmap.GlobalPipelineOptions()
options.num_threads = options.mapper.num_threads = threads
options.random_seed = options.mapper.random_seed = 0
adjustment = options.mapper.bundle_adjustment
adjustment.ceres.use_gpu = options.mapper.global_positioning.use_gpu = False
adjustment.refine_focal_length = adjustment.refine_extra_params = not k
shutil.rmtree(work)
os.makedirs(work)
keep("global", stage("global", lambda: pycolmap.global_mapping(database, images, work, options=options)))
shutil.rmtree(work)
os.remove(database)
print(json.dumps({"version": f"pycolmap {pycolmap.__version__}", "stages": stages, "load": load}))
