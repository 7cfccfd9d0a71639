"""Ceres, through COLMAP's bundle adjustment, on a generated problem; one JSON line per loss and linear solver.
usage: adjust_ceres.py MODEL_FOLDER THREADS TOLERANCE LOSS_SCALE"""
import json, sys, time
import pycolmap

folder, threads, tolerance, scale = sys.argv[1], int(sys.argv[2]), float(sys.argv[3]), float(sys.argv[4])
print(json.dumps({"versions": f"pycolmap {pycolmap.__version__}, Ceres {getattr(pycolmap, '__ceres_version__', '')}"}))


def solve(loss, solver):
    model = pycolmap.Reconstruction(folder)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_principal_point = False
    options.ceres.loss_function_type = getattr(pycolmap.LossFunctionType, loss)
    options.ceres.loss_function_scale = scale
    options.ceres.min_num_residuals_for_cpu_multi_threading = 0
    settings = options.ceres.solver_options
    settings.num_threads = threads
    settings.function_tolerance = tolerance
    settings.gradient_tolerance = 0.0
    settings.parameter_tolerance = 0.0
    settings.max_num_iterations = 100
    if solver != "AUTO":
        options.ceres.auto_select_solver_type = False
        settings.linear_solver_type = getattr(type(settings.linear_solver_type), solver)
    config = pycolmap.BundleAdjustmentConfig()
    for image in model.images:
        config.add_image(image)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    # The time of its construction is excluded; ours includes it.
    adjuster = pycolmap.create_default_bundle_adjuster(options, config, model)
    start = time.perf_counter()
    report = adjuster.solve()
    seconds = time.perf_counter() - start
    summary = report.ceres_summary
    # Ceres' cost is half the sum of squares.
    return {"loss": loss, "solver": solver, "initial_cost": 2 * summary.initial_cost, "cost": 2 * summary.final_cost,
            "iterations": summary.num_successful_steps + summary.num_unsuccessful_steps,
            "seconds": min(seconds, summary.total_time_in_seconds)}


for loss in ("TRIVIAL", "CAUCHY"):
    for solver in ("AUTO", "SPARSE_SCHUR", "DENSE_SCHUR"):
        print(json.dumps(solve(loss, solver)), flush=True)
