"""Small scenes of textured planes, rendered with NumPy alone: cameras and depths are known exactly."""

import functools

import numpy as np


def texture(seed):
    """Returns the color at each position of a plane: noise of several scales, in meters."""
    random = np.random.default_rng(seed)
    layers = [(random.uniform(0, 1, (257, 257, 3)), cell) for cell in (0.7, 0.2, 0.06, 0.025)]

    def color(u, v):
        total = np.zeros(u.shape + (3,))
        for values, cell in layers:
            x, y = np.mod(u / cell, 256), np.mod(v / cell, 256)
            i, j = x.astype(int), y.astype(int)
            a, b = (x - i)[..., None], (y - j)[..., None]
            top = values[j, i] * (1 - a) + values[j, i + 1] * a
            total += top * (1 - b) + (values[j + 1, i] * (1 - a) + values[j + 1, i + 1] * a) * b
        return 255 * np.clip((total / len(layers) - 0.5) * 1.8 + 0.5, 0, 1)

    return color


def chessboard(columns, rows, square):
    """Returns the colors of a chessboard on white; the origin is the first inner corner."""

    def color(u, v):
        i, j = np.floor(u / square).astype(int), np.floor(v / square).astype(int)
        board = (-1 <= i) & (i < columns) & (-1 <= j) & (j < rows)
        dark = board & ((i + j) % 2 == 0)
        return np.repeat(np.where(dark, 30.0, 225.0)[..., None], 3, axis=-1)

    return color


def rotation(x, y, z):
    """Returns the rotation by angles about the axes in radians, z first."""
    cos, sin = np.cos([x, y, z]), np.sin([x, y, z])
    about_x = np.array([[1, 0, 0], [0, cos[0], -sin[0]], [0, sin[0], cos[0]]])
    about_y = np.array([[cos[1], 0, sin[1]], [0, 1, 0], [-sin[1], 0, cos[1]]])
    about_z = np.array([[cos[2], -sin[2], 0], [sin[2], cos[2], 0], [0, 0, 1]])
    return about_x @ about_y @ about_z


def render(planes, matrix, pose, size, oversampling=3):
    """Renders a photograph of a pinhole camera: planes are (origin, axis u, axis v, color), the pose is R, t of x = R X + t. Also returns the depth of each pixel's center."""
    (width, height), (r, t) = size, pose
    step = (np.arange(oversampling) - (oversampling - 1) / 2) / oversampling
    sums, depth = np.zeros((height, width, 3)), None
    for dy in step:
        for dx in step:
            x, y = np.meshgrid(np.arange(width) + dx, np.arange(height) + dy)
            rays = np.stack([x, y, np.ones_like(x)], axis=2) @ np.linalg.inv(matrix).T @ r
            center = -r.T @ t
            nearest, visible = np.full(x.shape, np.inf), np.full(x.shape, -1)
            for i, (origin, u, v, _) in enumerate(planes):
                normal = np.cross(u, v)
                with np.errstate(divide="ignore", invalid="ignore"):
                    distance = ((np.asarray(origin) - center) @ normal) / (rays @ normal)
                hit = (distance > 0) & (distance < nearest)
                nearest[hit], visible[hit] = distance[hit], i
            image = np.zeros(x.shape + (3,))
            for i, (origin, u, v, color) in enumerate(planes):
                hit = visible == i
                at = center + rays[hit] * nearest[hit, None] - origin
                image[hit] = color(at @ u, at @ v)
            sums += image
            if dx == 0 and dy == 0:
                depth = nearest
    return np.rint(sums / oversampling**2).astype(np.uint8), depth


def room(seed=1):
    """The corner of a room: two walls and a floor."""
    x, y, z = np.eye(3)
    wall, other, floor = (texture(10 * seed + i) for i in range(3))
    return [((0, 0, 6), x, y, wall), ((3, 0, 0), z, y, other), ((0, 1.4, 0), x, z, floor)]


WALK_MATRIX = np.array([[400.0, 0, 199.5], [0, 400.0, 149.5], [0, 0, 1]])
WALK_SIZE = (400, 300)


def walk_poses():
    """Poses along a line through the room, each rotated a little more to the right."""
    for i in range(5):
        turn = rotation(0.02 * (i % 2), 0.25 - 0.07 * i, 0)
        center = np.array([-0.6 + 0.45 * i, 0.05 * (i % 2), -0.1 * i])
        yield turn, -turn @ center


@functools.cache
def walk():
    """Returns five photographs of the room from `walk_poses`."""
    return tuple(render(room(), WALK_MATRIX, pose, WALK_SIZE)[0] for pose in walk_poses())
