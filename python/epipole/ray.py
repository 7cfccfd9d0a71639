"""The same jobs over many photographs on a cluster, by Ray Data: ``pip install 'epipole[ray]'``.

Each function takes a list of paths, or a Ray Dataset with them in columns, and a folder for the results that all nodes share. Paths are sent to the workers, which read the photographs themselves, with
one thread each. The result is a Dataset of a row for each photograph: its paths, the ``output``, some figures, whether it was ``skipped`` because its output was there from an earlier run, and the ``error`` in
place of one that could not be done: a bad file ends no job.

Results are written whole or not at all, so that a run that was stopped goes on where it ended when it is started again with the same folder and options.
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
"""Times that a worker which died is started again, and that the photographs it had are tried again."""
_ROWS = 8
"""Photographs in one task: few are lost where a worker dies, and a task's overhead of milliseconds is spread over some."""


def depth(pairs, output, *, actors=None, restarts=_RESTARTS, names=None, **options):
    """Disparity, and depth where focal and baseline or a rig are given, of rectified pairs or of those of the rig.

    pairs: (left, right) paths, or a Dataset with columns ``left`` and ``right``. Writes NAME.npz with ``disparity``, ``state`` and, where it is known, ``depth``; options are those of
    :func:`epipole.depth`.
    """
    return _run("depth", _Depth, pairs, ("left", "right"), output, ".npz", actors, restarts, names, options)


def segment(images, output, *, model, actors=None, restarts=_RESTARTS, names=None, min_score=None):
    """Masks of an object by its color: NAME_mask.png.

    model: a fitted :class:`epipole.ColorModel`, or the path of a saved one.
    """
    model = model if isinstance(model, epipole.ColorModel) else epipole.ColorModel.load(model)
    options = {"model": model._fitted().to_json(), "min_score": min_score}
    return _run("segment", _Segment, images, ("image",), output, "_mask.png", actors, restarts, names, options)


def undistort(images, output, *, camera, actors=None, restarts=_RESTARTS, names=None, **options):
    """Photographs of one camera without the distortion of its lens: NAME.png. Options are those of :func:`epipole.undistort`."""
    options = {"camera": camera, **options}
    return _run("undistort", _Undistort, images, ("image",), output, ".png", actors, restarts, names, options)


def features(images, output, *, actors=None, restarts=_RESTARTS, names=None, **options):
    """Keypoints and descriptors: NAME.npz with ``keypoints``, ``descriptors`` and ``kind``. Options are those of :func:`epipole.extract_features`."""
    return _run("features", _Features, images, ("image",), output, ".npz", actors, restarts, names, options)


def match_pairs(pairs, output, *, actors=None, restarts=_RESTARTS, names=None, **options):
    """Matches of pairs of files that :func:`features` wrote: NAME.npz with ``points``, ``indices`` and ``ratios``. Options are those of :func:`epipole.match`.

    pairs: (a, b) paths, or a Dataset with columns ``a`` and ``b``.
    """
    return _run("match_pairs", _Match, pairs, ("a", "b"), output, ".npz", actors, restarts, names, options)


def sfm(photographs, output, *, actors=None, restarts=_RESTARTS, names=None, max_features=None, **options):
    """:func:`epipole.sfm` with the features of the photographs found on the cluster, into NAME.pickle; pairs and the solution are the work of the process that calls.

    photographs: paths, or a Dataset with a column ``image``. Returns the result, whose ``left_out`` also has those of which no features could be found. The files are read back with ``pickle``: the folder
    must be one that nobody else writes into.
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
    # A wrong option is told of here, not by every row.
    worker(output=str(output), ending=ending, options=options)
    _same_options(output / "options.json", job, options)
    if not ray.is_initialized():
        # Without an address Ray attaches to whatever cluster was last started on this machine, even one that has died: its file stays behind.
        ray.init(address=os.environ.get("RAY_ADDRESS", "local"), include_dashboard=False, log_to_driver=False)
    if actors is None:
        # One processor is left to reading and to Ray itself: a pool on all of them waits for ever for the tasks that feed it.
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
        # Of those that have no named parameter.
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
    """A row for each photograph or pair, under a name of its own."""
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
        raise ValueError(f"{len(twice)} results would have the name of another, such as {min(twice)}: give names=")
    return [{"name": name, **row} for name, row in zip(names, rows)]


def _name(row, columns):
    """The name of the first file; of matches, both."""
    return "-".join(Path(row[column]).stem for column in (columns if columns == ("a", "b") else columns[:1]))


def _same_options(path, job, options):
    """Results of other options are not to be taken for those of these."""
    told = {"job": job, "version": epipole.__version__, "options": options}
    # Cameras and rigs to their last digit, which their texts leave out.
    text = json.dumps(told, default=lambda value: pickle.dumps(value, 4).hex(), sort_keys=True)
    if path.exists():
        if path.read_text(encoding="utf-8") != text:
            raise ValueError(f"{path.parent} holds results of another job, of other options or of another version: name another folder")
        return
    _write(path, lambda file: file.write(text.encode()))


def _write(path, write):
    """Writes a file whole or not at all."""
    handle, temporary = tempfile.mkstemp(dir=os.path.dirname(path), prefix=".epipole-")
    try:
        with os.fdopen(handle, "wb") as file:
            write(file)
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise


class _Worker:
    """One photograph after the other; what goes wrong with one is its row's error."""

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
    """The options, of one thread, where they are the function's."""
    known = epipole.defaults(function)
    for name in options:
        if name not in known or name in ("threads", "progress"):
            raise TypeError(f"{function}() over Ray takes no option {name!r}; there are {', '.join(known)}")
    return {**options, "threads": 1}


class _Depth(_Worker):
    columns, figures = ("left", "right"), ("matched_fraction",)

    def prepare(self, **options):
        self.options = _checked("depth", options)

    def do(self, row, path):
        left, right = (epipole.read_image(row[column]) for column in self.columns)
        found = epipole.depth(left, right, **self.options)
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
    """The features that :func:`features` wrote."""
    with np.load(path) as arrays:
        return epipole.Features(arrays["keypoints"], arrays["descriptors"], str(arrays["kind"]))
