"""Results of random scenes."""

from tests.support.table_results import run


def result(name, prior, scored, true=3.0, failed=(), depth=0.1, plane=1.0):
    start = {
        "velocity_error_in_plane_percent": plane,
        "velocity_error_depth": depth,
        "velocity_std_depth": 0.1,
        "angular_velocity_error_camera": [0.2, -0.6, 0.01],
        "angular_velocity_std_camera": [0.1, 0.2, 0.1],
        "angular_velocity_error_viewing_percent": 0.5,
        "angular_velocity_error_percent": 8.0,
    }
    rmse = {"nclaw": prior, "neuma": scored, "true_law": true}
    metrics = {method: run(value, stable=method not in failed) for method, value in rmse.items()}
    return {"name": name, "family": "hencky", "prior": "jelly", "metrics": metrics, "start": start}


METHODS = {"nclaw": "NCLaw", "neuma": "NeuMA", "true_law": "True law"}
