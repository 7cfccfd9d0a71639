"""OpenCV's Stitcher: photographs to a panorama; prints one JSON line. usage: panorama_opencv.py panorama|scans THREADS OUT IMAGES…

`cpu` is the processor time from reading the first photograph to writing the panorama, without the startup of Python."""
import json, resource, sys, time
import cv2

mode, threads, out = sys.argv[1], int(sys.argv[2]), sys.argv[3]
cv2.setNumThreads(threads)
cv2.setRNGSeed(0)
wall, cpu = time.perf_counter(), time.process_time()
images = [cv2.imread(path) for path in sys.argv[4:]]
stitcher = cv2.Stitcher_create(cv2.Stitcher_PANORAMA if mode == "panorama" else cv2.Stitcher_SCANS)
status, panorama = stitcher.stitch(images)
row = {"version": f"OpenCV {cv2.__version__}", "used": 0, "size": [0, 0], "mean": 0.0}
if status == cv2.Stitcher_OK:
    cv2.imwrite(out, panorama)
row |= {"seconds": time.perf_counter() - wall, "cpu": time.process_time() - cpu,
        "peak": 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss}
if status == cv2.Stitcher_OK:
    inside = panorama.any(axis=2)
    row |= {"used": len(stitcher.component()), "size": panorama.shape[1::-1], "mean": float(panorama[inside].mean())}
print(json.dumps(row))
