"""Jobs over many photographs on a cluster, with Ray Data: ``pip install 'epipole[ray]'``.

Each function takes a list of paths, or a Ray Dataset with columns of paths, and a shared output folder. Workers get the paths, read the photographs themselves and use one thread each. The result is a
Dataset with a row for each photograph: its paths, the ``output``, statistics, whether it was ``skipped`` because its output exists from an earlier run, and the ``error`` if it failed; a failed photograph
does not fail the job.

Outputs are written atomically, so that a stopped run can be continued by starting it again with the same folder and options.
"""

import dataclasses
import json
import os
import pickle
import tempfile
import warnings
from pathlib import Path

import numpy as np

import epipole

_RESTARTS = 3
"""Maximum number of restarts of a failed worker, and of retries of its photographs."""
_ROWS = 8
"""Photographs per task: few are lost if a worker dies, and the overhead of some milliseconds per task is amortized."""


def depth(pairs, output, *, actors=None, restarts=_RESTARTS, names=None, **options):
    """Computes disparity, and depth if focal and baseline or a rig are given, of rectified pairs or of pairs of the rig.

    pairs: (left, right) paths, or a Dataset with columns ``left`` and ``right``. Writes NAME.npz with ``disparity``, ``state`` and, if known, ``depth``; options are those of
    :func:`epipole.depth`.
    """
    return _run("depth", _Depth, pairs, ("left", "right"), output, ".npz", actors, restarts, names, options)


def segment(images, output, *, model, actors=None, restarts=_RESTARTS, names=None, min_score=None):
    """Segments an object by color: NAME_mask.png.

    model: a fitted :class:`epipole.ColorModel`, or the path of a saved one.
    """
    model = model if isinstance(model, epipole.ColorModel) else epipole.ColorModel.load(model)
    options = {"model": model._fitted().to_json(), "min_score": min_score}
    return _run("segment", _Segment, images, ("image",), output, "_mask.png", actors, restarts, names, options)


def undistort(images, output, *, camera, actors=None, restarts=_RESTARTS, names=None, **options):
    """Undistorts photographs of one camera: NAME.png. Options are those of :func:`epipole.undistort`."""
    options = {"camera": camera, **options}
    return _run("undistort", _Undistort, images, ("image",), output, ".png", actors, restarts, names, options)


def features(images, output, *, actors=None, restarts=_RESTARTS, names=None, **options):
    """Extracts keypoints and descriptors: NAME.npz with ``keypoints``, ``descriptors`` and ``kind``. Options are those of :func:`epipole.extract_features`."""
    return _run("features", _Features, images, ("image",), output, ".npz", actors, restarts, names, options)


def match_pairs(pairs, output, *, actors=None, restarts=_RESTARTS, names=None, **options):
    """Matches pairs of files written by :func:`features`: NAME.npz with ``points``, ``indices`` and ``ratios``. Options are those of :func:`epipole.match`.

    pairs: (a, b) paths, or a Dataset with columns ``a`` and ``b``.
    """
    return _run("match_pairs", _Match, pairs, ("a", "b"), output, ".npz", actors, restarts, names, options)


def sfm(photographs, output, *, actors=None, restarts=_RESTARTS, names=None, max_features=None, **options):
    """:func:`epipole.sfm` with features extracted on the cluster, into NAME.pickle; matching and reconstruction run in the calling process.

    photographs: paths, or a Dataset with a column ``image``. Returns the result, whose ``left_out`` includes photographs without features. The files are read back with ``pickle``: the folder
    must not be writable by others.
    """
    found = _run("sfm", _SfmFeatures, photographs, ("image",), output, ".pickle", actors, restarts, names, {"max_features": max_features})
    rows = sorted(found.take_all(), key=lambda row: row["name"])
    labels = [os.path.basename(row["image"]) for row in rows]
    if len(set(labels)) < len(labels):
        labels = [row["name"] for row in rows]
    seen = {}
    for label, row in zip(labels, rows):
        if row["error"] is None:
            with open(row["output"], "rb") as file:
                seen[label] = pickle.load(file)
    result = epipole.sfm(list(seen.values()), names=list(seen), **options)
    unread = {label: {"kind": "Unreadable", "message": row["error"]} for label, row in zip(labels, rows) if row["error"]}
    return dataclasses.replace(result, left_out={**unread, **result.left_out})


def _run(job, worker, given, columns, output, ending, actors, restarts, names, options):
    import ray

    output = Path(output).absolute()
    output.mkdir(parents=True, exist_ok=True)
    # Invalid options are reported here, not by every row.
    worker(output=str(output), ending=ending, options=options)
    _same_options(output / "options.json", job, options)
    if not ray.is_initialized():
        # Without an address Ray attaches to whatever cluster was last started on this machine, even one that has died: its file stays behind.
        ray.init(address=os.environ.get("RAY_ADDRESS", "local"), include_dashboard=False, log_to_driver=False)
    if actors is None:
        # One processor is left for reading and for Ray itself: a pool on all of them deadlocks with the tasks that feed it.
        actors = max(1, int(ray.cluster_resources().get("CPU", 2)) - 1)
    if isinstance(given, ray.data.Dataset):
        if names is not None:
            raise TypeError("names go with a list of paths; a Dataset has them in its column “name”")
        rows = given
    else:
        listed = _rows(given, columns, names)
        tasks = -(-len(listed) // _ROWS)
        rows, actors = ray.data.from_items(listed, override_num_blocks=tasks), min(actors, tasks)
    with warnings.catch_warnings():
        # max_restarts and max_task_retries have no named parameter.
        warnings.filterwarnings("ignore", "`ray_remote_args` is deprecated")
        done = rows.map(
            worker,
            fn_constructor_kwargs={"output": str(output), "ending": ending, "options": options},
            compute=ray.data.ActorPoolStrategy(size=actors),
            num_cpus=1,
            max_restarts=restarts,
            max_task_retries=restarts,
        )
    return done.materialize()


def _rows(given, columns, names):
    """Returns a row for each photograph or pair, with a unique name."""
    rows = []
    for i, paths in enumerate(given):
        paths = [paths] if len(columns) == 1 else list(paths)
        if len(paths) != len(columns):
            raise ValueError(f"entry {i} has {len(paths)} paths; it takes {' and '.join(columns)}")
        rows.append({column: os.path.abspath(path) for column, path in zip(columns, paths)})
    if not rows:
        raise ValueError("there are no photographs")
    if names is None:
        names = [_name(row, columns) for row in rows]
    names = [str(name) for name in names]
    if len(names) != len(rows):
        raise ValueError(f"{len(names)} names for {len(rows)} results")
    twice = {name for name in names if names.count(name) > 1} if len(set(names)) < len(names) else ()
    if twice:
        raise ValueError(f"{len(twice)} results would have the same name as another, such as {min(twice)}: give names=")
    return [{"name": name, **row} for name, row in zip(names, rows)]


def _name(row, columns):
    """Returns the stem of the first file; for matches, of both."""
    return "-".join(Path(row[column]).stem for column in (columns if columns == ("a", "b") else columns[:1]))


def _same_options(path, job, options):
    """Refuses a folder with results of another job, other options or another version."""
    content = {"job": job, "version": epipole.__version__, "options": options}
    # Cameras and rigs are pickled to keep all digits, which their texts do not have.
    text = json.dumps(content, default=lambda value: pickle.dumps(value, 4).hex(), sort_keys=True)
    if path.exists():
        if path.read_text(encoding="utf-8") != text:
            raise ValueError(f"{path.parent} has results of another job, other options or another version: use another folder")
        return
    _write(path, lambda file: file.write(text.encode()))


def _write(path, write):
    """Writes a file atomically."""
    handle, temporary = tempfile.mkstemp(dir=os.path.dirname(path), prefix=".epipole-")
    try:
        with os.fdopen(handle, "wb") as file:
            write(file)
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise


class _Worker:
    """Processes photographs one at a time; an exception becomes the error of the row."""

    def __init__(self, output, ending, options):
        self.output, self.ending = output, ending
        self.prepare(**options)

    def __call__(self, row):
        name = row.get("name") or _name(row, self.columns)
        path = os.path.join(self.output, f"{name}{self.ending}")
        figures = dict.fromkeys(self.figures)
        skipped, error = os.path.exists(path), None
        if not skipped:
            try:
                figures.update(self.do(row, path))
            except Exception as failed:
                error = f"{type(failed).__name__}: {failed}"
        output = None if error else path
        return {**row, "name": name, "output": output, **figures, "skipped": skipped, "error": error}

    def prepare(self, **options):
        self.options = options

    def do(self, row, path):
        raise NotImplementedError


def _arrays(path, arrays):
    _write(path, lambda file: np.savez(file, **{name: value for name, value in arrays.items() if value is not None}))


def _checked(function, options):
    """Checks the options against those of the function, and sets one thread."""
    known = epipole.defaults(function)
    for name in options:
        if name not in known or name in ("threads", "progress"):
            raise TypeError(f"{function}() over Ray takes no option {name!r}; there are {', '.join(known)}")
    return {**options, "threads": 1}


class _Depth(_Worker):
    columns, figures = ("left", "right"), ("matched_fraction",)

    def prepare(self, **options):
        self.matcher = epipole._native.PairDepth(**_checked("depth", options))

    def do(self, row, path):
        left, right = (epipole.read_image(row[column]) for column in self.columns)
        found = self.matcher.compute(left, right)
        _arrays(path, {"disparity": found.disparity, "state": found.state, "depth": found.depth})
        return {"matched_fraction": found.matched_fraction}


class _Segment(_Worker):
    columns, figures = ("image",), ("found", "fraction")

    def prepare(self, model, min_score):
        self.model, self.min_score = epipole._native.FittedColorModel.from_json(model), min_score

    def do(self, row, path):
        found = self.model.locate(epipole.read_image(row["image"]), min_score=self.min_score, threads=1)
        epipole.write_image(path, found.mask.astype(np.uint8) * 255)
        return {"found": sum(o.found for o in found.objects), "fraction": float(found.mask.mean())}


class _Undistort(_Worker):
    columns, figures = ("image",), ()

    def prepare(self, camera, **options):
        self.undistorter = epipole.Undistorter(camera, **_checked("Undistorter", options))

    def do(self, row, path):
        epipole.write_image(path, self.undistorter.compute(epipole.read_image(row["image"])))
        return {}


class _Features(_Worker):
    columns, figures = ("image",), ("count",)

    def prepare(self, **options):
        self.options = _checked("extract_features", options)

    def do(self, row, path):
        found = epipole.extract_features(epipole.read_image(row["image"]), **self.options)
        _arrays(path, {"keypoints": found.keypoints, "descriptors": found.descriptors, "kind": np.array(found.kind)})
        return {"count": len(found)}


class _SfmFeatures(_Worker):
    columns, figures = ("image",), ("count",)

    def prepare(self, **options):
        self.options = _checked("sfm_features", options)

    def do(self, row, path):
        found = epipole.sfm_features(row["image"], **self.options)
        _write(path, lambda file: pickle.dump(found, file))
        return {"count": len(found)}


class _Match(_Worker):
    columns, figures = ("a", "b"), ("count",)

    def prepare(self, **options):
        self.options = _checked("match", options)

    def do(self, row, path):
        found = epipole.match(*(load_features(row[column]) for column in self.columns), **self.options)
        _arrays(path, {"points": found.points, "indices": found.indices, "ratios": found.ratios})
        return {"count": len(found)}


def load_features(path):
    """Reads features written by :func:`features`."""
    with np.load(path) as arrays:
        return epipole.Features(arrays["keypoints"], arrays["descriptors"], str(arrays["kind"]))
