// Exact ray casting on the grid, as `maps::OccupancyGrid::cast` does it, and the beam model on top.
//
// No invocation writes where another one reads or writes: each has its own element of `results`, and its own of `partial`
// until the barrier.

struct Job {
    // Cells of the grid, and words per row of `cells`.
    width: u32,
    height: u32,
    words_per_row: u32,
    // Particles or rays, and workgroups along x.
    count: u32,
    groups_x: u32,
    // Beams, and the length of a beam's row in `rows`.
    beams: u32,
    row_length: u32,
    // Log-likelihood of a particle outside the track, of all beams.
    off_track: f32,
    // The laser on base_link, and the greatest range [cells].
    laser: vec2<f32>,
    longest: f32,
    steps_per_cell: f32,
}

@group(0) @binding(0) var<uniform> job: Job;
// Two bits for each cell: 1 is occupied, 2 is free, 0 is unknown.
@group(0) @binding(1) var<storage, read> cells: array<u32>;
// Particles as x, y [cells], cosine and sine of the heading; or rays as start [cells] and direction.
@group(0) @binding(2) var<storage, read> poses: array<vec4<f32>>;
// Directions of the beams on the car: cosine and sine.
@group(0) @binding(3) var<storage, read> beams: array<vec2<f32>>;
// For each beam, the log-likelihood of what it measured by the step of the predicted range.
@group(0) @binding(4) var<storage, read> rows: array<f32>;
// Log-weights, or ranges [cells].
@group(0) @binding(5) var<storage, read_write> results: array<f32>;

const OCCUPIED: u32 = 1u;
const FREE: u32 = 2u;

// The state of a cell; unknown outside the grid.
fn state(column: i32, row: i32) -> u32 {
    if column < 0 || row < 0 || column >= i32(job.width) || row >= i32(job.height) {
        return 0u;
    }
    let word = u32(row) * job.words_per_row + (u32(column) >> 4u);
    return (cells[word] >> ((u32(column) & 15u) << 1u)) & 3u;
}

// The cell of a point, for points that may lie anywhere.
fn cell_of(point: vec2<f32>) -> vec2<i32> {
    // Comparisons with NaN are false.
    let inside = point.x >= 0.0 && point.y >= 0.0 && point.x < f32(job.width) && point.y < f32(job.height);
    if !inside {
        return vec2<i32>(-1, -1);
    }
    return vec2<i32>(floor(point));
}

// Range to the first occupied cell [cells]; `job.longest` without one, 0 from where it is not free.
fn cast_ray(start: vec2<f32>, direction: vec2<f32>) -> f32 {
    let first = cell_of(start);
    if state(first.x, first.y) != FREE {
        return 0.0;
    }
    let within = start - vec2<f32>(first);
    let forward = direction >= vec2<f32>(0.0);
    let step = select(vec2<i32>(-1), vec2<i32>(1), forward);
    // Path per cell along each axis; a ray along an axis never crosses the other.
    let steep = abs(direction) > vec2<f32>(1e-9);
    let between = select(vec2<f32>(1e9), abs(1.0 / direction), steep);
    // Path to the first crossing. Those after it are computed from their number, so that errors do not add up.
    let to_edge = select(within, 1.0 - within, forward) * between;
    var crossed = vec2<f32>(0.0);
    var cell = first;
    // A ray crosses at most so many edges on its way out of the grid.
    let most = job.width + job.height + 2u;
    for (var i = 0u; i < most; i++) {
        let next = to_edge + crossed * between;
        let along_y = next.y < next.x;
        let path = select(next.x, next.y, along_y);
        if path >= job.longest {
            return job.longest;
        }
        if along_y {
            cell.y += step.y;
            crossed.y += 1.0;
        } else {
            cell.x += step.x;
            crossed.x += 1.0;
        }
        if cell.x < 0 || cell.y < 0 || cell.x >= i32(job.width) || cell.y >= i32(job.height) {
            return job.longest;
        }
        if state(cell.x, cell.y) == OCCUPIED {
            return path;
        }
    }
    return job.longest;
}

// One ray for each invocation.
@compute @workgroup_size(64)
fn ranges(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let i = (group.y * job.groups_x + group.x) * 64u + local;
    if i < job.count {
        let ray = poses[i];
        results[i] = cast_ray(ray.xy, ray.zw);
    }
}

// Invocations that share a particle, each with every eighth beam.
const LANES: u32 = 8u;
var<workgroup> partial: array<f32, 64>;

// Eight particles for each workgroup: the log-likelihood of the scan.
@compute @workgroup_size(64)
fn weights(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let i = (group.y * job.groups_x + group.x) * 8u + local / LANES;
    var sum = 0.0;
    var on_track = false;
    if i < job.count {
        let pose = poses[i];
        let heading = pose.zw;
        let at = pose.xy + vec2<f32>(
            job.laser.x * heading.x - job.laser.y * heading.y,
            job.laser.x * heading.y + job.laser.y * heading.x,
        );
        let first = cell_of(at);
        on_track = state(first.x, first.y) == FREE;
        if on_track {
            for (var k = local % LANES; k < job.beams; k += LANES) {
                let beam = beams[k];
                let direction = vec2<f32>(
                    heading.x * beam.x - heading.y * beam.y,
                    heading.y * beam.x + heading.x * beam.y,
                );
                let predicted = u32(cast_ray(at, direction) * job.steps_per_cell);
                sum += rows[k * job.row_length + min(predicted, job.row_length - 1u)];
            }
        }
    }
    partial[local] = sum;
    workgroupBarrier();
    if local % LANES == 0u && i < job.count {
        var total = job.off_track;
        if on_track {
            total = 0.0;
            for (var k = 0u; k < LANES; k++) {
                total += partial[local + k];
            }
        }
        results[i] = total;
    }
}
