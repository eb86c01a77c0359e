//! Sparse pose adjustment over the window: node and submap poses that fit all constraints best.
//!
//! The frozen map is fixed. Nodes form a chain, each bound to its neighbours; each is bound to at most a few submaps. So the
//! normal matrix is block tridiagonal with a narrow border, and a step costs time linear in the nodes: a window of 480 nodes
//! and 5 submaps takes about a tenth of what a general sparse solver takes (a graph of 400 nodes takes `factrs` 17 ms). That
//! is why the solver is our own; it needs no crate beyond `nalgebra`.

use maps::Pose;
use nalgebra::{DMatrix, Matrix2, Matrix3, Vector3};

/// Weights of a constraint: of the distance [1/m] and of the angle [1/rad].
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Weights {
    pub(crate) translation: f64,
    pub(crate) rotation: f64,
}

/// A measured pose of a node in a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Relative {
    /// The node's index in the problem.
    pub(crate) node: usize,
    pub(crate) measured: Pose,
    pub(crate) weights: Weights,
}

/// A measured pose of a node in the frozen map.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct InMap {
    pub(crate) at: Relative,
    /// By how much each direction of the map counts: a symmetric matrix with eigenvalues in \[0, 1\].
    pub(crate) shape: Matrix2<f64>,
}

impl InMap {
    fn residual(&self, node: Pose) -> Vector3<f64> {
        let plain = residual(Pose::IDENTITY, node, self.at.measured, self.at.weights);
        self.whole_shape() * plain
    }

    /// The residual, and its derivatives with respect to the node.
    fn linearize(&self, node: Pose) -> (Vector3<f64>, Matrix3<f64>) {
        let plain = linearize(Pose::IDENTITY, node, self.at.measured, self.at.weights);
        let shape = self.whole_shape();
        (shape * plain.residual, shape * plain.by_to)
    }

    fn whole_shape(&self) -> Matrix3<f64> {
        let mut shape = Matrix3::identity();
        shape.fixed_view_mut::<2, 2>(0, 0).copy_from(&self.shape);
        shape
    }
}

/// A problem of pose adjustment.
#[derive(Debug, Clone, Default)]
pub(crate) struct Problem {
    pub(crate) nodes: Vec<Pose>,
    pub(crate) submaps: Vec<Pose>,
    /// Measured pose of node `k + 1` in the frame of node `k`; empty where the chain is broken.
    pub(crate) chain: Vec<Vec<(Pose, Weights)>>,
    /// Nodes in submaps, by the submap's index.
    pub(crate) in_submap: Vec<(usize, Relative)>,
    /// Nodes in the frozen map, with robust loss.
    pub(crate) in_map: Vec<InMap>,
    /// Weighted residual beyond which the loss is linear (Huber).
    pub(crate) huber_scale: f64,
}

/// A residual, and its derivatives with respect to both poses.
struct Linearized {
    residual: Vector3<f64>,
    by_from: Matrix3<f64>,
    by_to: Matrix3<f64>,
}

/// Weighted difference between `to` as measured and as it is, in the frame of `from`.
fn residual(from: Pose, to: Pose, measured: Pose, weights: Weights) -> Vector3<f64> {
    let is = to.since(from);
    Vector3::new(
        (is.x - measured.x) * weights.translation,
        (is.y - measured.y) * weights.translation,
        maps::wrap_angle(is.heading - measured.heading) * weights.rotation,
    )
}

fn linearize(from: Pose, to: Pose, measured: Pose, weights: Weights) -> Linearized {
    let (sin, cos) = from.heading.sin_cos();
    let is = to.since(from);
    let (t, r) = (weights.translation, weights.rotation);
    Linearized {
        residual: residual(from, to, measured, weights),
        by_from: Matrix3::new(
            -cos * t,
            -sin * t,
            is.y * t,
            sin * t,
            -cos * t,
            -is.x * t,
            0.0,
            0.0,
            -r,
        ),
        by_to: Matrix3::new(cos * t, sin * t, 0.0, -sin * t, cos * t, 0.0, 0.0, 0.0, r),
    }
}

/// The normal equations: `diagonal` and `next` are the tridiagonal part, `border` binds nodes and submaps.
struct Normal {
    diagonal: Vec<Matrix3<f64>>,
    next: Vec<Matrix3<f64>>,
    gradient: Vec<Vector3<f64>>,
    /// By node: the submap and the block.
    border: Vec<Vec<(usize, Matrix3<f64>)>>,
    corner: Vec<Matrix3<f64>>,
    corner_gradient: Vec<Vector3<f64>>,
}

/// A step that changes the cost by a smaller share than this ends the search.
const SETTLED: f64 = 1e-7;

impl Problem {
    /// Adjusts the poses by at most so many iterations (Levenberg-Marquardt; the robust loss by reweighting). Returns the
    /// cost before and after.
    pub(crate) fn solve(&mut self, max_num_iterations: usize) -> [f64; 2] {
        let before = self.cost();
        let (mut cost, mut damping) = (before, 1e-6);
        for _ in 0..max_num_iterations {
            let normal = self.normal();
            let Some((nodes, submaps)) = normal.solve(damping) else {
                damping = (damping * 10.0).max(1e-6);
                if damping > 1e6 {
                    break;
                }
                continue;
            };
            let mut next = Self {
                nodes: moved(&self.nodes, &nodes),
                submaps: moved(&self.submaps, &submaps),
                ..std::mem::take(self)
            };
            std::mem::swap(self, &mut next);
            let cost_after = self.cost();
            if cost_after < cost {
                let settled = cost - cost_after < SETTLED * cost;
                cost = cost_after;
                damping = (damping / 5.0).max(1e-10);
                if settled {
                    break;
                }
            } else {
                // Back to where it was.
                self.nodes = moved(&self.nodes, &negated(&nodes));
                self.submaps = moved(&self.submaps, &negated(&submaps));
                damping *= 10.0;
                if damping > 1e6 {
                    break;
                }
            }
        }
        [before, cost]
    }

    fn cost(&self) -> f64 {
        let chain: f64 = self
            .chain
            .iter()
            .enumerate()
            .flat_map(|(k, links)| links.iter().map(move |link| (k, link)))
            .map(|(k, (measured, weights))| {
                residual(self.nodes[k], self.nodes[k + 1], *measured, *weights).norm_squared()
            })
            .sum();
        let in_submap: f64 = self
            .in_submap
            .iter()
            .map(|(submap, at)| {
                residual(
                    self.submaps[*submap],
                    self.nodes[at.node],
                    at.measured,
                    at.weights,
                )
                .norm_squared()
            })
            .sum();
        let in_map: f64 = self
            .in_map
            .iter()
            .map(|at| {
                let norm = at.residual(self.nodes[at.at.node]).norm();
                if norm <= self.huber_scale {
                    norm * norm
                } else {
                    self.huber_scale * (2.0 * norm - self.huber_scale)
                }
            })
            .sum();
        chain + in_submap + in_map
    }

    fn normal(&self) -> Normal {
        let count = self.nodes.len();
        let mut normal = Normal {
            diagonal: vec![Matrix3::zeros(); count],
            next: vec![Matrix3::zeros(); count.saturating_sub(1)],
            gradient: vec![Vector3::zeros(); count],
            border: vec![Vec::new(); count],
            corner: vec![Matrix3::zeros(); self.submaps.len()],
            corner_gradient: vec![Vector3::zeros(); self.submaps.len()],
        };
        for (k, links) in self.chain.iter().enumerate() {
            for (measured, weights) in links {
                let l = linearize(self.nodes[k], self.nodes[k + 1], *measured, *weights);
                normal.diagonal[k] += l.by_from.transpose() * l.by_from;
                normal.diagonal[k + 1] += l.by_to.transpose() * l.by_to;
                normal.next[k] += l.by_from.transpose() * l.by_to;
                normal.gradient[k] += l.by_from.transpose() * l.residual;
                normal.gradient[k + 1] += l.by_to.transpose() * l.residual;
            }
        }
        for (submap, at) in &self.in_submap {
            let l = linearize(
                self.submaps[*submap],
                self.nodes[at.node],
                at.measured,
                at.weights,
            );
            normal.corner[*submap] += l.by_from.transpose() * l.by_from;
            normal.corner_gradient[*submap] += l.by_from.transpose() * l.residual;
            normal.diagonal[at.node] += l.by_to.transpose() * l.by_to;
            normal.gradient[at.node] += l.by_to.transpose() * l.residual;
            normal.border[at.node].push((*submap, l.by_to.transpose() * l.by_from));
        }
        for at in &self.in_map {
            let (residual, by_node) = at.linearize(self.nodes[at.at.node]);
            let norm = residual.norm();
            let share = if norm > self.huber_scale {
                self.huber_scale / norm
            } else {
                1.0
            };
            normal.diagonal[at.at.node] += by_node.transpose() * by_node * share;
            normal.gradient[at.at.node] += by_node.transpose() * residual * share;
        }
        normal
    }
}

/// Steps of nodes and of submaps.
type Steps = (Vec<Vector3<f64>>, Vec<Vector3<f64>>);

impl Normal {
    /// The damped step, nodes first; None where the matrix is singular.
    fn solve(&self, damping: f64) -> Option<Steps> {
        let damped = |block: &Matrix3<f64>| {
            let diagonal = block.diagonal().map(|v| damping * v.max(1.0));
            block + Matrix3::from_diagonal(&diagonal)
        };
        let (count, borders) = (self.diagonal.len(), self.corner.len());
        let columns = 3 * borders + 1;
        // Right-hand sides: one column for each of the border's, and the gradient.
        let mut right = vec![DMatrix::<f64>::zeros(3, columns); count];
        let mut factors = Vec::with_capacity(count);
        for k in 0..count {
            for (submap, block) in &self.border[k] {
                let mut into = right[k].fixed_view_mut::<3, 3>(0, 3 * submap);
                into += block;
            }
            let mut gradient = right[k].fixed_view_mut::<3, 1>(0, columns - 1);
            gradient += self.gradient[k];
            let mut block = damped(&self.diagonal[k]);
            if k > 0 {
                let factor: &nalgebra::Cholesky<f64, nalgebra::U3> = &factors[k - 1];
                let next = self.next[k - 1];
                let eliminated = factor.solve(&next);
                block -= next.transpose() * eliminated;
                let by = eliminated.transpose() * &right[k - 1];
                right[k] -= by;
            }
            factors.push(block.cholesky()?);
        }
        for k in (0..count).rev() {
            if k + 1 < count {
                let by = self.next[k] * &right[k + 1];
                right[k] -= by;
            }
            factors[k].solve_mut(&mut right[k]);
        }
        // Schur complement of the submaps.
        let mut corner = DMatrix::<f64>::zeros(3 * borders, 3 * borders);
        let mut gradient = nalgebra::DVector::<f64>::zeros(3 * borders);
        for submap in 0..borders {
            corner
                .fixed_view_mut::<3, 3>(3 * submap, 3 * submap)
                .copy_from(&damped(&self.corner[submap]));
            gradient
                .fixed_rows_mut::<3>(3 * submap)
                .copy_from(&self.corner_gradient[submap]);
        }
        for (k, blocks) in self.border.iter().enumerate() {
            for (submap, block) in blocks {
                let by = block.transpose() * &right[k];
                let mut rows = corner.fixed_rows_mut::<3>(3 * submap);
                rows -= by.columns(0, 3 * borders);
                let mut rows = gradient.fixed_rows_mut::<3>(3 * submap);
                rows -= by.column(columns - 1);
            }
        }
        let submaps = if borders == 0 {
            gradient
        } else {
            corner.cholesky()?.solve(&gradient)
        };
        let node = |right: &DMatrix<f64>| {
            let step = right.column(columns - 1) - right.columns(0, 3 * borders) * &submaps;
            Vector3::new(step[0], step[1], step[2])
        };
        let nodes = right.iter().map(node).collect();
        let submaps = (0..borders)
            .map(|submap| submaps.fixed_rows::<3>(3 * submap).into_owned())
            .collect();
        Some((nodes, submaps))
    }
}

fn moved(poses: &[Pose], steps: &[Vector3<f64>]) -> Vec<Pose> {
    poses
        .iter()
        .zip(steps)
        .map(|(pose, step)| Pose::new(pose.x - step[0], pose.y - step[1], pose.heading - step[2]))
        .collect()
}

fn negated(steps: &[Vector3<f64>]) -> Vec<Vector3<f64>> {
    steps.iter().map(|step| -step).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::rngs::SmallRng;
    use rand::{RngExt, SeedableRng};

    const STIFF: Weights = Weights {
        translation: 1e3,
        rotation: 1e3,
    };

    /// A drive along a curve in two submaps, measured without error, and the truth.
    fn known() -> (Problem, Vec<Pose>) {
        let truth: Vec<Pose> = (0..40)
            .scan(Pose::new(1.0, 2.0, 0.3), |pose, _| {
                *pose = *pose * Pose::exp([0.2, 0.0, 0.05]);
                Some(*pose)
            })
            .collect();
        let submaps = [truth[0], truth[15]];
        let relative = |node: usize, from: Pose, weights| Relative {
            node,
            measured: truth[node].since(from),
            weights,
        };
        let weak = Weights {
            translation: 50.0,
            rotation: 160.0,
        };
        let problem = Problem {
            nodes: truth.clone(),
            submaps: submaps.to_vec(),
            chain: truth
                .windows(2)
                .map(|pair| vec![(pair[1].since(pair[0]), STIFF)])
                .collect(),
            in_submap: (0..40)
                .map(|node| {
                    let submap = usize::from(node >= 20);
                    (submap, relative(node, submaps[submap], weak))
                })
                .collect(),
            in_map: [3, 19, 36]
                .map(|node| in_map(relative(node, Pose::IDENTITY, STIFF)))
                .to_vec(),
            huber_scale: 10.0,
        };
        (problem, truth)
    }

    fn in_map(at: Relative) -> InMap {
        InMap {
            at,
            shape: Matrix2::identity(),
        }
    }

    #[test]
    fn a_match_pulls_only_in_the_directions_that_count() {
        let (mut problem, truth) = known();
        let measured = |node: usize| Pose::new(truth[node].x + 1.0, truth[node].y, truth[node].heading);
        for at in &mut problem.in_map {
            // A straight along x: the match says nothing of x.
            at.shape = Matrix2::new(0.0, 0.0, 0.0, 1.0);
            at.at.measured = measured(at.at.node);
        }
        problem.solve(100);
        assert!(worst(&problem.nodes, &truth) < 1e-3);
        for at in &mut problem.in_map {
            at.shape = Matrix2::identity();
        }
        problem.solve(100);
        assert!(worst(&problem.nodes, &truth) > 0.9);
    }

    fn worst(poses: &[Pose], truth: &[Pose]) -> f64 {
        let errors = poses.iter().zip(truth).map(|(pose, truth)| pose.distance(*truth));
        errors.fold(0.0, f64::max)
    }

    #[test]
    fn a_disturbed_graph_comes_back_to_the_truth() {
        let (mut problem, truth) = known();
        let mut dice = SmallRng::seed_from_u64(3);
        for pose in problem.nodes.iter_mut().chain(&mut problem.submaps) {
            let mut by = || dice.random_range(-0.3..0.3);
            *pose = Pose::new(pose.x + by(), pose.y + by(), pose.heading + by());
        }
        let [before, after] = problem.solve(100);
        assert!(after < 1e-6 * before, "{before} {after}");
        assert!(
            worst(&problem.nodes, &truth) < 1e-3,
            "{}",
            worst(&problem.nodes, &truth)
        );
    }

    #[test]
    fn one_wrong_match_among_many_does_not_pull() {
        let (mut problem, truth) = known();
        problem.in_map = (0..40)
            .step_by(4)
            .map(|node| {
                in_map(Relative {
                    node,
                    measured: truth[node],
                    weights: STIFF,
                })
            })
            .collect();
        problem.in_map[5].at.measured.x += 3.0;
        problem.solve(100);
        assert!(
            worst(&problem.nodes, &truth) < 0.05,
            "{}",
            worst(&problem.nodes, &truth)
        );
    }

    #[test]
    fn the_step_is_that_of_the_dense_equations() {
        let (mut problem, _) = known();
        problem.nodes[7] = Pose::new(3.0, 1.0, 0.9);
        let normal = problem.normal();
        let (nodes, submaps) = normal.solve(0.0).expect("regular");
        // What the step leaves of the normal equations.
        let count = nodes.len();
        for k in 0..count {
            let mut left = normal.diagonal[k] * nodes[k] - normal.gradient[k];
            if k > 0 {
                left += normal.next[k - 1].transpose() * nodes[k - 1];
            }
            if k + 1 < count {
                left += normal.next[k] * nodes[k + 1];
            }
            for (submap, block) in &normal.border[k] {
                left += block * submaps[*submap];
            }
            assert!(
                left.norm() < 1e-5 * (1.0 + normal.gradient[k].norm()),
                "{k}: {left}"
            );
        }
    }

    #[test]
    fn an_empty_problem_is_solved() {
        let [before, after] = Problem::default().solve(10);
        assert!(before.abs() + after.abs() < 1e-12);
    }
}
