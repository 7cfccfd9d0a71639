"""Runs a program, its output to a file; prints one JSON line of what it cost, and ends as it did.
usage: measure.py OUTPUT PROGRAM ARGUMENTS…"""
import json, os, subprocess, sys, time

start = time.perf_counter()
with open(sys.argv[1], "wb") as output:
    child = subprocess.Popen(sys.argv[2:], stdout=output)
    _, status, usage = os.wait4(child.pid, 0)
# The peak includes what this script holds while it starts the program: ten megabytes, below that of any job.
print(json.dumps({"seconds": time.perf_counter() - start, "cpu": usage.ru_utime + usage.ru_stime,
                  "peak": 1024 * usage.ru_maxrss}))
sys.exit(os.waitstatus_to_exitcode(status))
