// Fills in what a view has of the sensor's two poses, so that the host only copies them.
#include "poses.cuh"
#include "view.cuh"

// One thread per view. `pairs` [count][2][4][4] are the poses (world_from_sensor) at both ends of the exposure. The views
// come with `reference`, and with `moving` set where rays have instants of their own.
extern "C" __global__ void __launch_bounds__(THREADS)
place_views(const double* pairs, int count, View* views) {
    int k = blockIdx.x * THREADS + threadIdx.x;
    if (k >= count) return;
    View& view = views[k];
    const double *from = pairs + 32 * (size_t)k, *to = from + 16;
    Pose start = load_pose(from), end = load_pose(to), reference = between(from, to, view.reference);
    const double *s = start.rotation, *e = end.rotation, *r = reference.rotation;
    double swing[9];            // start^T end, in the sensor's own frame, in which the axis of a constant turn is fixed
    bool moves = false;
    for (int i = 0; i < 12; ++i) moves = moves || from[i] != to[i];
    for (int i = 0; i < 3; ++i) {
        double travel = 0, behind = 0;
        for (int k = 0; k < 3; ++k) {
            travel += r[3 * k + i] * (end.translation[k] - start.translation[k]);
            behind += e[3 * k + i] * (reference.translation[k] - end.translation[k]);
        }
        for (int j = 0; j < 3; ++j) {
            double back = 0, turn = 0;
            for (int k = 0; k < 3; ++k) back += e[3 * k + i] * r[3 * k + j], turn += s[3 * k + i] * e[3 * k + j];
            // Sweeps report points in the sensor's frame at the end of the exposure.
            view.end_from_reference[4 * i + j] = (float)back;
            view.turn[3 * i + j] = (float)r[3 * j + i];
            swing[3 * i + j] = turn;
        }
        view.end_from_reference[4 * i + 3] = (float)behind;
        view.eye[i] = reference.translation[i];
        view.travel[i] = (float)travel;
    }
    double q[4];
    quat_of(swing, q);
    double sine = sqrt(q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    // Axis times angle; the limit of angle / sine is 2.
    double scale = sine > 1e-12 ? 2 * atan2(sine, q[0]) / sine : 2;
    for (int i = 0; i < 3; ++i) view.swing[i] = (float)(scale * q[1 + i]);
    view.moving = view.moving && moves;
}
