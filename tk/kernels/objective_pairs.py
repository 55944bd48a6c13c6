"""Pairs of the objective: surface samples with voxels, voxels with pieces. For :mod:`tk.kernels.objective`."""

from tk.kernels.columns import SCALAR, TRANSFORM, VECTOR, columns
from tk.kernels.kinematics import load_rotation, load_translation, store_frame
from tk.kernels.nearest import nearest_voxel
from tk.kernels.pieces import PIECE_DOF, PIECE_NUMBERS, PIECE_SHAPE, place_piece, to_zero_configuration
from tk.kernels.runtime import ti
from tk.kernels.superellipsoid import implicit, project
from tk.kernels.vectors import cross, norm_sqr, times, transposed_times, triple, triple_in
from tk.kernels.wrench import MOTION, WRENCH, add_wrench

# Columns of a sample.
_POSITION, SAMPLE_DOF, SAMPLE_PATCH, SAMPLE_BARRED, _ = columns(VECTOR, SCALAR, SCALAR, SCALAR)
# Columns of a piece, after those of PieceArrays. Its colour patches, a bit mask of 63, are in three numbers of 21 bits,
# which a float32 represents exactly.
PIECE_PART, PIECE_PATCHES = PIECE_NUMBERS, PIECE_NUMBERS + 1
PATCH_BITS = 21
# Columns of the scratch's rows of pieces, which follow the joints: 3×4 frame in the world, bounding sphere.
_FRAME, SPHERE, SPHERE_RADIUS, _ = columns(TRANSFORM, VECTOR, SCALAR)
# A point is deep inside a piece where G (1 on the surface, growing linearly from the centre) is below this.
BURIED = 0.8
# Indices of the packed settings; the grid of tk.kernels.nearest follows from GRID on.
INV_SIGMA2, REACH, NU, COVERAGE_NU, SCALE, COVERAGE_SCALE, GRID = range(7)


@ti.func
def place_pieces(
    scratch: ti.template(),  # (C, D + P, 39), joints placed
    c: int,
    D: int,
    pieces: ti.template(),  # (P, 24)
):
    """Store the pieces' frames in the world and their bounding spheres in the scratch."""
    for i in range(pieces.shape[0]):
        R, t, center, radius = place_piece(scratch, c, pieces, i)
        store_frame(scratch, c, D + i, R, t)
        for a in ti.static(range(3)):
            scratch[c, D + i, SPHERE + a] = center[a]
        scratch[c, D + i, SPHERE_RADIUS] = radius


@ti.func
def has_patch(pieces: ti.template(), i: int, fits: ti.i64):
    """Return whether piece i has any of the patches of a bit mask."""
    common = 0
    for part in ti.static(range(3)):
        patches = ti.cast(pieces[i, PIECE_PATCHES + part], ti.i32)
        common |= patches & ti.cast((fits >> (PATCH_BITS * part)) & ((1 << PATCH_BITS) - 1), ti.i32)
    return common != 0


@ti.func
def nearest_piece(
    scratch: ti.template(),  # (C, D + P, 39), joints and pieces placed
    c: int,
    D: int,
    pieces: ti.template(),  # (P, 24)
    fits: ti.i64,  # the voxel's
    y,  # voxel, world
    reach,
):
    """Return the piece nearest to a voxel, or -1, and the nearest point (3,) on it in the zero configuration."""
    best = -1
    best_d = reach
    best_on = y * 0.0
    # the first candidate, by the bounding spheres, bounds the distance of the others
    likely = 0
    least = y[0] * 0.0 + 1e30
    for i in range(pieces.shape[0]):
        radius = scratch[c, D + i, SPHERE_RADIUS]
        power = norm_sqr(y - triple_in(scratch, c, D + i, SPHERE)) - radius * radius
        if power < least:
            least, likely = power, i
    for turn in range(pieces.shape[0] + 1):
        i = ti.select(turn == 0, likely, turn - 1)
        within = best_d + scratch[c, D + i, SPHERE_RADIUS]
        if turn > 0 and (i == likely or norm_sqr(y - triple_in(scratch, c, D + i, SPHERE)) >= within * within):
            continue
        R = load_rotation(scratch, c, D + i)
        q = transposed_times(R, y - load_translation(scratch, c, D + i))
        radii = triple(pieces, i, PIECE_SHAPE)
        z_lower, z_upper = pieces[i, PIECE_SHAPE + 5], pieces[i, PIECE_SHAPE + 6]
        # a voxel farther outside the piece's box than the best distance has no nearer point on it
        over = ti.Vector(
            [
                ti.max(ti.abs(q[0]) - radii[0], 0.0),
                ti.max(ti.abs(q[1]) - radii[1], 0.0),
                ti.max(ti.max(z_lower - q[2], q[2] - z_upper), 0.0),
            ]
        )
        if norm_sqr(over) < best_d * best_d and has_patch(pieces, i, fits):
            on = project(q, radii, pieces[i, PIECE_SHAPE + 3], pieces[i, PIECE_SHAPE + 4], z_lower, z_upper)
            d = ti.sqrt(norm_sqr(q - on))
            # of two equally near pieces the first, in any order of visits
            if d < best_d or (d == best_d and i < best):
                best = i
                best_d = d
                best_on = on
    best_x = best_on
    if best >= 0:
        best_x = to_zero_configuration(pieces, best, best_on)
    return best, best_x


@ti.func
def add_residual(
    scratch: ti.template(),
    sums: ti.template(),
    c: int,
    k: int,  # last degree of freedom above x
    x,
    r,
    inv_sigma2,
    nu,
    scale,
):
    """Add scale·ρ(e) of one pair to row c of the sums, its gradient and Hessian-vector product to the wrenches."""
    decay = ti.exp(-0.5 * norm_sqr(r) * inv_sigma2 / nu)
    sums[c, 0] = sums[c, 0] + scale * (1.0 - decay)
    weight = scale * decay / nu * inv_sigma2
    Jv = cross(triple_in(scratch, c, k, MOTION), x) + triple_in(scratch, c, k, MOTION + 3)
    add_wrench(scratch, c, k, WRENCH, weight * cross(x, r), weight * r)
    add_wrench(scratch, c, k, WRENCH + 6, weight * cross(x, Jv), weight * Jv)


@ti.func
def is_buried(
    scratch: ti.template(),  # (C, D + P, 39), joints and pieces placed
    c: int,
    D: int,
    pieces: ti.template(),  # (P, 24)
    barred: int,
    x,
):
    """Return whether a world point lies deep inside a piece of a part in the bit mask ``barred``."""
    buried = False
    i = 0
    while not buried and i < pieces.shape[0]:
        radius = scratch[c, D + i, SPHERE_RADIUS]
        if (
            barred >> ti.cast(pieces[i, PIECE_PART], ti.i32) & 1 == 1
            and norm_sqr(x - triple_in(scratch, c, D + i, SPHERE)) < radius * radius
        ):
            q = transposed_times(load_rotation(scratch, c, D + i), x - load_translation(scratch, c, D + i))
            radii = triple(pieces, i, PIECE_SHAPE)
            # G is at least the greatest of |q| / a
            if (
                q[2] > pieces[i, PIECE_SHAPE + 5]
                and q[2] < pieces[i, PIECE_SHAPE + 6]
                and ti.abs(q / radii).max() < BURIED
            ):
                buried = implicit(q, radii, pieces[i, PIECE_SHAPE + 3], pieces[i, PIECE_SHAPE + 4])[0] < BURIED
        i += 1
    return buried


@ti.func
def pair_sample(
    samples: ti.template(),
    pieces: ti.template(),
    voxels: ti.template(),
    fits: ti.template(),
    starts: ti.template(),
    settings: ti.template(),
    scratch: ti.template(),
    c: int,
    D: int,
    n: int,
):
    """Return the voxel of surface sample n, or -1."""
    k = ti.cast(samples[n, SAMPLE_DOF], ti.i32)
    R = load_rotation(scratch, c, k)
    x = times(R, triple(samples, n, 0)) + load_translation(scratch, c, k)
    v = -1
    barred = ti.cast(samples[n, SAMPLE_BARRED], ti.i32)
    if barred == 0 or not is_buried(scratch, c, D, pieces, barred, x):
        v = nearest_voxel(
            voxels,
            fits,
            starts,
            settings,
            GRID,
            x,
            ti.cast(samples[n, SAMPLE_PATCH], ti.i32),
            ti.cast(settings[REACH], ti.f32),
        )
    return v


@ti.func
def assign(
    samples: ti.template(),
    pieces: ti.template(),
    voxels: ti.template(),
    fits: ti.template(),
    starts: ti.template(),
    settings: ti.template(),
    chosen: ti.template(),
    scratch: ti.template(),
    b: int,
    c: int,
    D: int,
    m: int,
    M: int,
    assigned: ti.template(),
    covering: ti.template(),
):
    """Assign a voxel to sample m of pose b, or a piece and its nearest point to voxel m - M of the coverage term."""
    if m < M:
        n = chosen[b, m]
        assigned[b, m] = pair_sample(samples, pieces, voxels, fits, starts, settings, scratch, c, D, n)
    else:
        v = chosen[b, m]
        y = load_voxel(voxels, v, settings[0])
        i, x0 = nearest_piece(scratch, c, D, pieces, fits[v], y, settings[REACH])
        covering[b, m - M, 0] = i
        for a in ti.static(range(3)):
            covering[b, m - M, 1 + a] = x0[a]


@ti.func
def load_voxel(voxels: ti.template(), v: int, like):
    """Return voxel v (3,) in the precision of ``like``."""
    zero = like * 0.0
    return ti.Vector([zero + voxels[v, a] for a in ti.static(range(3))])


@ti.func
def load_pair(
    samples: ti.template(),
    pieces: ti.template(),
    settings: ti.template(),
    chosen: ti.template(),
    assigned: ti.template(),
    covering: ti.template(),
    b: int,
    m: int,
    M: int,
):
    """Return pair m of pose b as assigned: the voxel or -1, the last degree of freedom above the point, the point in
    the zero configuration, ν and the pair's share of f."""
    v, k = -1, 0
    x0 = ti.Vector([settings[0] * 0.0, settings[0] * 0.0, settings[0] * 0.0])
    nu, scale = settings[NU], settings[SCALE]
    if m < M:
        n = chosen[b, m]
        v = assigned[b, m]
        k = ti.cast(samples[n, SAMPLE_DOF], ti.i32)
        x0 = triple(samples, n, 0)
    else:
        nu, scale = settings[COVERAGE_NU], settings[COVERAGE_SCALE]
        i = ti.cast(covering[b, m - M, 0], ti.i32)
        if i >= 0:
            v = chosen[b, m]
            k = ti.cast(pieces[i, PIECE_DOF], ti.i32)
            x0 = triple_in(covering, b, m - M, 1)
    return v, k, x0, nu, scale
