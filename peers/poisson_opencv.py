"""OpenCV's seamlessClone of one megapixel; prints its seconds, the fastest of three runs. usage: poisson_opencv.py THREADS SOURCE TARGET"""
import sys, time
import cv2, numpy

cv2.setNumThreads(int(sys.argv[1]))
source, target = (cv2.resize(cv2.imread(path), (1000, 1000)) for path in sys.argv[2:4])
mask = numpy.zeros((1000, 1000), numpy.uint8)
mask[1:-1, 1:-1] = 255
seconds = []
for _ in range(3):
    start = time.perf_counter()
    cv2.seamlessClone(source, target, mask, (500, 500), cv2.NORMAL_CLONE)
    seconds.append(time.perf_counter() - start)
print(min(seconds))
