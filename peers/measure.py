"""Runs a program with its output redirected to a file; prints its cost as one JSON line and exits with its status.
usage: measure.py OUTPUT PROGRAM ARGUMENTS…"""
import json, os, subprocess, sys, time

start = time.perf_counter()
with open(sys.argv[1], "wb") as output:
    child = subprocess.Popen(sys.argv[2:], stdout=output)
    _, status, usage = os.wait4(child.pid, 0)
# The peak is at least the memory of this script at the start, ten megabytes, which is below that of any job.
print(json.dumps({"seconds": time.perf_counter() - start, "cpu": usage.ru_utime + usage.ru_stime,
                  "peak": 1024 * usage.ru_maxrss}))
sys.exit(os.waitstatus_to_exitcode(status))
