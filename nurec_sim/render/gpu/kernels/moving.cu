// Puts the moving layer in place for every view (layers.moving_gaussians): where its Gaussians are at the view's
// reference instant, how far they have faded in or out, and where an actor that is posed anew takes them.
#include "colours.cuh"
#include "poses.cuh"
#include "view.cuh"

// How an actor is moved from where its Gaussians are given, row-major, and whether it is absent.
struct Motion {
    double rotation[9], translation[3];
    float quat[4];
    float moved, gone;
};
static_assert(sizeof(Motion) == 120, "gpu/moving.py makes room for it");

// The pose of a path at an instant, held before its first sample and after its last (geometry.interpolate_poses).
INLINE Pose on_path(const long long* times, const double* poses, int first, int last, long long now) {
    int low = first, high = last - 1;  // the last sample that is not later than now
    if (now < times[low]) now = times[low];
    while (low < high) {
        int middle = (low + high + 1) / 2;
        if (times[middle] <= now) low = middle;
        else high = middle - 1;
    }
    if (low == last - 1) return load_pose(poses + 16 * (size_t)low);
    double fraction = (double)(now - times[low]) / (double)(times[low + 1] - times[low]);
    const double* from = poses + 16 * (size_t)low;
    return fraction > 0 ? between(from, from + 16, fraction) : load_pose(from);
}

INLINE Motion motion_of(const Pose& pose, bool gone) {
    Motion motion;
    double q[4];
    quat_of(pose.rotation, q);
    for (int k = 0; k < 9; ++k) motion.rotation[k] = pose.rotation[k];
    for (int k = 0; k < 3; ++k) motion.translation[k] = pose.translation[k];
    for (int k = 0; k < 4; ++k) motion.quat[k] = (float)q[k];
    motion.moved = 1, motion.gone = gone ? 1 : 0;
    return motion;
}

// One thread per track (x) and view (y): how its Gaussians are moved in that view, those in the world first, then those
// in its box. `asked` [views][tracks] is the pair of `pairs` [n][2][4][4] that the request has for the track; -1 for
// none, -2 for a hidden track. Track k is recorded by samples firsts[k] to firsts[k + 1] - 1.
extern "C" __global__ void __launch_bounds__(THREADS)
move_tracks(const View* views, int tracks, const int* asked, const double* pairs, const int* firsts,
            const long long* times, const double* poses, Motion* motions) {
    int track = blockIdx.x * THREADS + threadIdx.x;
    if (track >= tracks) return;
    const View& view = views[blockIdx.y];
    Motion& in_world = motions[((size_t)blockIdx.y * 2) * tracks + track];
    Motion& in_box = motions[((size_t)blockIdx.y * 2 + 1) * tracks + track];
    int pair = asked[(size_t)blockIdx.y * tracks + track], first = firsts[track], last = firsts[track + 1];
    long long now = view.instant_us;
    in_world.moved = in_world.gone = pair == -2 ? 1 : 0;
    in_box.moved = in_box.gone = 1;
    if (pair == -2) return;
    Pose recorded = on_path(times, poses, first, last, now);
    if (pair < 0) {
        in_box = motion_of(recorded, now < times[first] || now > times[last - 1]);
        return;
    }
    Pose shown = between(pairs + 32 * (size_t)pair, pairs + 32 * (size_t)pair + 16, view.reference), carried;
    const double *s = shown.rotation, *r = recorded.rotation;
    for (int i = 0; i < 3; ++i) {
        double moved = shown.translation[i];
        for (int j = 0; j < 3; ++j) {
            double turn = s[3 * i] * r[3 * j] + s[3 * i + 1] * r[3 * j + 1] + s[3 * i + 2] * r[3 * j + 2];
            carried.rotation[3 * i + j] = turn;
            moved -= turn * recorded.translation[j];
        }
        carried.translation[i] = moved;
    }
    in_world = motion_of(carried, false);
    in_box = motion_of(shown, false);
}

// One block of threads per block of Gaussians (x) and view (y). `recorded` [blocks][FIELDS][BLOCK] holds the middle
// knots and opacities that are not capped yet; `knots` [blocks][3 knots][3][BLOCK] positions; `times` [blocks][3][BLOCK]
// microseconds; `tracks` [blocks][BLOCK] rows of `motions` [views][track_count], -1 for none.
extern "C" __global__ void __launch_bounds__(THREADS)
place_moving(const View* views, const float* recorded, const float* sh_rest, int sh_count, const float* knots,
             const long long* times, const int* tracks, const Motion* motions, int track_count,
             float log_max_opacity, float* placed) {
    int block = blockIdx.x, lane = threadIdx.x;
    const View& view = views[blockIdx.y];
    const float* f = recorded + (size_t)block * FIELDS * BLOCK + lane;
    float* out = placed + ((size_t)blockIdx.y * gridDim.x + block) * FIELDS * BLOCK + lane;
    const long long* time = times + (size_t)block * 3 * BLOCK + lane;
    long long now = view.instant_us, first = time[0], middle = time[BLOCK], last = time[2 * BLOCK];
    bool after = now >= middle;
    long long start = after ? middle : first, end = after ? last : middle;
    double fraction = (double)(now - start) / (double)(end - start > 1 ? end - start : 1);
    float age = (float)(after ? fraction : 1 - fraction), age2 = age * age, age4 = age2 * age2;
    float log_opacity = f[LOG_OPACITY * BLOCK] - age4 * age4 * age2;
    for (int k = 0; k < FIELDS; ++k) out[k * BLOCK] = f[k * BLOCK];
    if (!(first <= now && now <= last && log_opacity >= -LOG_255)) {
        out[LOG_OPACITY * BLOCK] = -1e9f;
        return;
    }
    out[LOG_OPACITY * BLOCK] = fminf(log_opacity, log_max_opacity);

    const float* knot = knots + ((size_t)block * 9 + (after ? 3 : 0)) * BLOCK + lane;
    double mean[3], eye[3] = {view.eye[0], view.eye[1], view.eye[2]};
    for (int k = 0; k < 3; ++k) mean[k] = knot[k * BLOCK] * (1 - fraction) + knot[(3 + k) * BLOCK] * fraction;
    double stays[3] = {mean[0], mean[1], mean[2]};
    int track = tracks[(size_t)block * BLOCK + lane];
    if (track >= 0 && motions[(size_t)blockIdx.y * track_count + track].moved > 0) {
        const Motion& motion = motions[(size_t)blockIdx.y * track_count + track];
        if (motion.gone > 0) {
            out[LOG_OPACITY * BLOCK] = -1e9f;
            return;
        }
        const double *r = motion.rotation, *t = motion.translation;
        float n[3] = {f[NORMAL * BLOCK], f[(NORMAL + 1) * BLOCK], f[(NORMAL + 2) * BLOCK]};
        double back[3] = {eye[0] - t[0], eye[1] - t[1], eye[2] - t[2]};
        for (int k = 0; k < 3; ++k) {
            mean[k] = r[3 * k] * stays[0] + r[3 * k + 1] * stays[1] + r[3 * k + 2] * stays[2] + t[k];
            eye[k] = r[k] * back[0] + r[3 + k] * back[1] + r[6 + k] * back[2];
            out[(NORMAL + k) * BLOCK] = (float)(r[3 * k] * n[0] + r[3 * k + 1] * n[1] + r[3 * k + 2] * n[2]);
        }
        const float* a = motion.quat;
        float w = f[QUAT * BLOCK], x = f[(QUAT + 1) * BLOCK], y = f[(QUAT + 2) * BLOCK], z = f[(QUAT + 3) * BLOCK];
        out[QUAT * BLOCK] = a[0] * w - a[1] * x - a[2] * y - a[3] * z;
        out[(QUAT + 1) * BLOCK] = a[0] * x + a[1] * w + a[2] * z - a[3] * y;
        out[(QUAT + 2) * BLOCK] = a[0] * y - a[1] * z + a[2] * w + a[3] * x;
        out[(QUAT + 3) * BLOCK] = a[0] * z + a[1] * y - a[2] * x + a[3] * w;
    }
    for (int k = 0; k < 3; ++k) out[(MEAN + k) * BLOCK] = (float)mean[k];
    if (sh_count > 0) {
        // The colour turns with the actor.
        float3 away = make_float3((float)(stays[0] - eye[0]), (float)(stays[1] - eye[1]), (float)(stays[2] - eye[2]));
        away = (1 / fmaxf(length(away), 1e-12f)) * away;
        const float* rest = sh_rest + (size_t)block * 3 * sh_count * BLOCK + lane;
        for (int k = 0; k < 3; ++k) {
            out[(COLOUR + k) * BLOCK] =
                fmaxf(f[(COLOUR + k) * BLOCK] + sh_channel(rest + k * BLOCK, sh_count, away), 0.0f);
        }
    }
}
