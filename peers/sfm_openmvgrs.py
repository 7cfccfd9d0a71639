"""OpenMVG-rs: photographs of a folder to a model as COLMAP's text; one JSON line.
usage: sfm_openmvgrs.py IMAGES OUT THREADS incremental|global [K.txt]

A K.txt is kept as it is; without it EXIF and adjustment. The folder holds photographs only: the library takes up a K.txt
that lies beside them. It tells no times of stages, so the whole call is one."""
import json, os, shutil, sys, time
from importlib.metadata import version
import openmvg_rs

images, out, threads, engine = sys.argv[1], sys.argv[2], int(sys.argv[3]), sys.argv[4]
k = sys.argv[5] if len(sys.argv) > 5 else None
os.makedirs(os.path.join(out, engine), exist_ok=True)
load = os.getloadavg()[0]
wall, cpu, error = time.perf_counter(), time.process_time(), None
try:
    scene = openmvg_rs.reconstruct(images, engine=engine, extraction_method="alp", seed=42, intrinsics=k, progress=False,
                                   max_workers=threads)
except openmvg_rs.OpenMVGError as e:
    scene, error = None, f"{type(e).__name__}: {e}"
row = {"name": engine, "seconds": time.perf_counter() - wall, "cpu": time.process_time() - cpu}
with open("/proc/self/status") as status:
    row["peak"] = next(1024 * int(line.split()[1]) for line in status if line.startswith("VmHWM"))
if scene:
    work = os.path.join(out, "work")
    scene.write_colmap(work)
    for name in ("cameras.txt", "images.txt", "points3D.txt"):
        os.replace(os.path.join(work, "sparse", "0", name), os.path.join(out, engine, name))
    shutil.rmtree(work)
print(json.dumps({"version": f"openmvg-rs {version('openmvg-rs')}", "stages": [row], "load": load, "error": error}))
