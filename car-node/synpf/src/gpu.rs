//! Ranges and weights computed on a graphics card, or on the CPU by a Vulkan driver such as Mesa's lavapipe.
//!
//! `gpu/ranges.wgsl` casts exact rays on the grid for many particles and beams at once and applies the beam model there. Per
//! scan the poses and one row of the beam model for each beam go in, and a log-likelihood for each particle comes out.
//!
//! A range ends within half a cell of a wall's face, like those of `maps::OccupancyGrid::cast`. From that cast it differs by
//! the rounding of `f32`, and where a ray grazes a corner it may pass on the other side of it.
//!
//! naga checks every index of the shader against the length of its buffer, beside the checks in the shader itself.

use std::pin::pin;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::task::{Context, Poll, Waker};
use std::time::Duration;

use maps::{Cell, OccupancyGrid};
use wgpu::util::{BufferInitDescriptor, DeviceExt};

/// Longest time that a batch may take on a card \[s\]. Beyond it the card counts as failed.
const PATIENCE: f64 = 2.0;

/// The same for a driver that computes on the CPU, which other programs use too, and as much again for each ray \[s\].
const PATIENCE_ON_CPU: [f64; 2] = [60.0, 1e-5];

/// Poses of one batch at most: their buffer takes 32 MB.
const BATCH: usize = 1 << 21;

/// Workgroups along one axis at most; every adapter can do that.
const MOST_GROUPS: u32 = 65_535;

/// Why nothing can be computed on a graphics card.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum GpuError {
    /// There is no adapter, or its driver does not start.
    #[error("no graphics adapter with Vulkan ({0}); install its driver, or choose lut, cddt or ray_marching")]
    NoAdapter(String),
    /// The map does not fit.
    #[error(
        "a map of {width} x {height} cells takes {needed} bytes, and {adapter} binds at most {most}; choose lut or cddt"
    )]
    MapTooLarge {
        /// Cells along x.
        width: usize,
        /// Cells along y.
        height: usize,
        /// Memory of the map \[bytes\].
        needed: u64,
        /// Largest buffer of the adapter \[bytes\].
        most: u64,
        /// The adapter's name.
        adapter: String,
    },
    /// A computation failed or did not end.
    #[error("{adapter}: {fault}")]
    Failed {
        /// The adapter's name.
        adapter: String,
        /// What went wrong.
        fault: String,
    },
}

/// An adapter with the compiled shader. There is one for the whole process.
#[derive(Debug)]
pub(crate) struct Gpu {
    adapter: String,
    /// The driver computes on the CPU.
    on_cpu: bool,
    device: wgpu::Device,
    queue: wgpu::Queue,
    layout: wgpu::BindGroupLayout,
    ranges: wgpu::ComputePipeline,
    weights: wgpu::ComputePipeline,
    /// Held from the first write of a run to its last result. The queue runs one at a time in any case, and where threads wrote to it
    /// between each other's writes and runs, two of fifteen runs of the tests on lavapipe got other weights; of thirty with this, none.
    turn: Mutex<()>,
    /// The first error that no call reported.
    fault: Arc<Mutex<Option<String>>>,
}

/// Which entry point of the shader runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Entry {
    Ranges,
    Weights,
}

impl Entry {
    /// Poses for each workgroup, as in the shader.
    fn per_group(self) -> usize {
        match self {
            Self::Ranges => 64,
            Self::Weights => 8,
        }
    }
}

/// Runs a future that a native back end has ready at once.
fn ready<T>(future: impl Future<Output = T>) -> Option<T> {
    let mut future = pin!(future);
    match future.as_mut().poll(&mut Context::from_waker(Waker::noop())) {
        Poll::Ready(value) => Some(value),
        Poll::Pending => None,
    }
}

impl Gpu {
    /// The process's adapter; it is opened with the first call.
    pub(crate) fn shared() -> Result<Arc<Self>, GpuError> {
        static SHARED: OnceLock<Result<Arc<Gpu>, GpuError>> = OnceLock::new();
        SHARED.get_or_init(|| Self::open().map(Arc::new)).clone()
    }

    fn open() -> Result<Self, GpuError> {
        let none = |why: String| GpuError::NoAdapter(why);
        let descriptor = wgpu::InstanceDescriptor {
            backends: wgpu::Backends::VULKAN,
            ..wgpu::InstanceDescriptor::new_without_display_handle()
        };
        let instance = wgpu::Instance::new(descriptor);
        let options = wgpu::RequestAdapterOptions {
            power_preference: wgpu::PowerPreference::HighPerformance,
            ..wgpu::RequestAdapterOptions::default()
        };
        let adapter = ready(instance.request_adapter(&options))
            .ok_or_else(|| none("the driver did not answer".into()))?
            .map_err(|error| none(error.to_string()))?;
        let info = adapter.get_info();
        let name = format!("{} ({:?}, {:?})", info.name, info.device_type, info.backend);
        let descriptor = wgpu::DeviceDescriptor {
            // Large maps and many particles take what the adapter has.
            required_limits: adapter.limits(),
            ..wgpu::DeviceDescriptor::default()
        };
        let (device, queue) = ready(adapter.request_device(&descriptor))
            .ok_or_else(|| none(format!("{name} did not answer")))?
            .map_err(|error| none(format!("{name}: {error}")))?;
        // Without a handler of ours an error would end the program.
        let fault = Arc::new(Mutex::new(None));
        let seen = Arc::clone(&fault);
        device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| {
            let mut fault = seen.lock().unwrap_or_else(PoisonError::into_inner);
            fault.get_or_insert_with(|| error.to_string());
        }));
        let module = device.create_shader_module(wgpu::ShaderModuleDescriptor {
            label: Some("ranges"),
            source: wgpu::ShaderSource::Wgsl(include_str!("gpu/ranges.wgsl").into()),
        });
        let storage = |read_only| wgpu::BufferBindingType::Storage { read_only };
        let entry = |(binding, ty)| wgpu::BindGroupLayoutEntry {
            binding,
            visibility: wgpu::ShaderStages::COMPUTE,
            ty: wgpu::BindingType::Buffer {
                ty,
                has_dynamic_offset: false,
                min_binding_size: None,
            },
            count: None,
        };
        let layout = device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
            label: None,
            entries: &[
                (0, wgpu::BufferBindingType::Uniform),
                (1, storage(true)),
                (2, storage(true)),
                (3, storage(true)),
                (4, storage(true)),
                (5, storage(false)),
            ]
            .map(entry),
        });
        let pipeline_layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
            bind_group_layouts: &[Some(&layout)],
            ..wgpu::PipelineLayoutDescriptor::default()
        });
        let pipeline = |entry_point| {
            device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
                label: Some(entry_point),
                layout: Some(&pipeline_layout),
                module: &module,
                entry_point: Some(entry_point),
                compilation_options: wgpu::PipelineCompilationOptions::default(),
                cache: None,
            })
        };
        let gpu = Self {
            ranges: pipeline("ranges"),
            weights: pipeline("weights"),
            adapter: name,
            on_cpu: info.device_type == wgpu::DeviceType::Cpu,
            device,
            queue,
            layout,
            turn: Mutex::new(()),
            fault,
        };
        gpu.check().map_err(|error| none(error.to_string()))?;
        Ok(gpu)
    }

    /// The adapter's name and kind.
    pub(crate) fn adapter(&self) -> &str {
        &self.adapter
    }

    fn failed(&self, fault: String) -> GpuError {
        GpuError::Failed {
            adapter: self.adapter.clone(),
            fault,
        }
    }

    /// The error that no call reported, if there was one.
    fn check(&self) -> Result<(), GpuError> {
        let mut fault = self.fault.lock().unwrap_or_else(PoisonError::into_inner);
        fault.take().map_or(Ok(()), |fault| Err(self.failed(fault)))
    }

    fn buffer(&self, size: u64, usage: wgpu::BufferUsages) -> wgpu::Buffer {
        self.device.create_buffer(&wgpu::BufferDescriptor {
            label: None,
            size,
            usage,
            mapped_at_creation: false,
        })
    }
}

/// What one run of the shader is about, as `Job` in the shader.
#[derive(Debug, Clone, Copy)]
struct Job {
    beams: u32,
    row_length: u32,
    off_track: f32,
    laser: [f32; 2],
    longest: f32,
    steps_per_cell: f32,
}

/// Buffers that one run needs. They grow with the runs and are kept.
#[derive(Debug)]
struct Buffers {
    /// Poses that fit.
    poses: usize,
    /// Beams that fit, and values in all of their rows.
    beams: [usize; 2],
    job: wgpu::Buffer,
    pose: wgpu::Buffer,
    beam: wgpu::Buffer,
    row: wgpu::Buffer,
    result: wgpu::Buffer,
    staging: wgpu::Buffer,
    group: wgpu::BindGroup,
    /// What is written to `pose`.
    bytes: Vec<u8>,
}

/// Beams for the weights: their directions on the car, and the row of the beam model for what each measured.
#[derive(Debug, Clone)]
pub(crate) struct WeighedBeams<'a> {
    /// Cosine and sine of the direction.
    pub(crate) directions: Vec<[f32; 2]>,
    /// Log-likelihoods by the step of the predicted range; all of one length.
    pub(crate) rows: Vec<&'a [f32]>,
    /// Log-likelihood of all beams from outside the track.
    pub(crate) off_track: f32,
    /// The laser on `base_link` \[cells\].
    pub(crate) laser: [f32; 2],
    /// Greatest range \[cells\].
    pub(crate) longest: f32,
    /// Steps of a row per cell.
    pub(crate) steps_per_cell: f32,
}

/// A map on the graphics card.
#[derive(Debug)]
pub(crate) struct GpuMap {
    gpu: Arc<Gpu>,
    width: u32,
    height: u32,
    words_per_row: u32,
    cells: wgpu::Buffer,
    buffers: Mutex<Option<Buffers>>,
    /// Set by the first run that failed.
    failed: AtomicBool,
}

fn bytes_of<const N: usize>(values: impl IntoIterator<Item = [f32; N]>, into: &mut Vec<u8>) {
    into.clear();
    for value in values.into_iter().flatten() {
        into.extend_from_slice(&value.to_ne_bytes());
    }
}

impl GpuMap {
    /// Copies a grid to the process's adapter.
    pub(crate) fn new(grid: &OccupancyGrid) -> Result<Self, GpuError> {
        let gpu = Gpu::shared()?;
        let words_per_row = grid.width.div_ceil(16);
        let needed = (words_per_row * grid.height * size_of::<u32>()) as u64;
        let limits = gpu.device.limits();
        let most = limits.max_storage_buffer_binding_size.min(limits.max_buffer_size);
        if needed > most {
            return Err(GpuError::MapTooLarge {
                width: grid.width,
                height: grid.height,
                needed,
                most,
                adapter: gpu.adapter.clone(),
            });
        }
        let mut words = vec![0u32; words_per_row * grid.height];
        for (row, cells) in grid.cells.chunks_exact(grid.width).enumerate() {
            for (column, cell) in cells.iter().enumerate() {
                let state = match cell {
                    Cell::Occupied => 1,
                    Cell::Free => 2,
                    Cell::Unknown => 0,
                };
                words[row * words_per_row + column / 16] |= state << (2 * (column % 16));
            }
        }
        let contents: Vec<u8> = words.into_iter().flat_map(u32::to_ne_bytes).collect();
        let cells = gpu.device.create_buffer_init(&BufferInitDescriptor {
            label: Some("cells"),
            contents: &contents,
            usage: wgpu::BufferUsages::STORAGE,
        });
        gpu.check()?;
        Ok(Self {
            gpu,
            width: grid.width as u32,
            height: grid.height as u32,
            words_per_row: words_per_row as u32,
            cells,
            buffers: Mutex::new(None),
            failed: AtomicBool::new(false),
        })
    }

    /// The adapter's name and kind.
    pub(crate) fn adapter(&self) -> &str {
        self.gpu.adapter()
    }

    /// Memory of the map on the card \[bytes\].
    pub(crate) fn bytes(&self) -> usize {
        self.cells.size() as usize
    }

    /// Ranges along rays \[cells\]: start \[cells\] and direction. At most `longest`.
    pub(crate) fn ranges(&self, rays: &[[f32; 4]], longest: f32) -> Result<Vec<f32>, GpuError> {
        let job = Job {
            beams: 0,
            row_length: 1,
            off_track: 0.0,
            laser: [0.0; 2],
            longest,
            steps_per_cell: 0.0,
        };
        let mut ranges = Vec::with_capacity(rays.len());
        let ray = |i: usize| rays[i];
        self.run(Entry::Ranges, job, rays.len(), ray, [&[], &[]], |part| {
            ranges.extend_from_slice(part);
        })?;
        Ok(ranges)
    }

    /// Calls `add` with the log-likelihoods of the beams for poses in their order, in parts. `pose` gives x, y \[cells\], cosine
    /// and sine of the heading.
    pub(crate) fn weigh(
        &self,
        count: usize,
        pose: impl Fn(usize) -> [f32; 4],
        beams: &WeighedBeams<'_>,
        add: impl FnMut(&[f32]),
    ) -> Result<(), GpuError> {
        let row_length = beams.rows.first().map_or(1, |row| row.len());
        let job = Job {
            beams: beams.rows.len() as u32,
            row_length: row_length as u32,
            off_track: beams.off_track,
            laser: beams.laser,
            longest: beams.longest,
            steps_per_cell: beams.steps_per_cell,
        };
        let (mut directions, mut rows) = (Vec::new(), Vec::new());
        bytes_of(beams.directions.iter().copied(), &mut directions);
        bytes_of(
            beams.rows.iter().flat_map(|row| row.iter().map(|value| [*value])),
            &mut rows,
        );
        self.run(Entry::Weights, job, count, pose, [&directions, &rows], add)
    }

    /// Runs an entry point over all poses, batch by batch. After a failure every run fails at once.
    fn run(
        &self,
        entry: Entry,
        job: Job,
        count: usize,
        pose: impl Fn(usize) -> [f32; 4],
        [directions, rows]: [&[u8]; 2],
        mut then: impl FnMut(&[f32]),
    ) -> Result<(), GpuError> {
        if self.failed.load(Ordering::Relaxed) {
            return Err(self.gpu.failed("failed before".into()));
        }
        let _turn = self.gpu.turn.lock().unwrap_or_else(PoisonError::into_inner);
        let mut kept = self.buffers.lock().unwrap_or_else(PoisonError::into_inner);
        let outcome = (0..count).step_by(BATCH).try_for_each(|begin| {
            let part = begin..(begin + BATCH).min(count);
            let sizes = [directions.len(), rows.len()];
            let mut buffers = match kept.take() {
                Some(buffers) if buffers.hold(part.len(), sizes) => buffers,
                _ => self.new_buffers(part.len(), sizes),
            };
            bytes_of(part.clone().map(&pose), &mut buffers.bytes);
            let queue = &self.gpu.queue;
            queue.write_buffer(&buffers.pose, 0, &buffers.bytes);
            if !rows.is_empty() {
                queue.write_buffer(&buffers.beam, 0, directions);
                queue.write_buffer(&buffers.row, 0, rows);
            }
            self.batch(entry, job, part.len(), &buffers, &mut then)?;
            *kept = Some(buffers);
            Ok(())
        });
        if outcome.is_err() {
            self.failed.store(true, Ordering::Relaxed);
        }
        outcome
    }

    /// Runs one batch, whose poses are written, and hands the results to `then`.
    fn batch(
        &self,
        entry: Entry,
        job: Job,
        count: usize,
        buffers: &Buffers,
        then: &mut impl FnMut(&[f32]),
    ) -> Result<(), GpuError> {
        let Gpu { device, queue, .. } = &*self.gpu;
        let groups = count.div_ceil(entry.per_group()) as u32;
        let groups_x = groups.min(MOST_GROUPS);
        let mut words = Vec::with_capacity(48);
        for word in [
            self.width,
            self.height,
            self.words_per_row,
            count as u32,
            groups_x,
            job.beams,
            job.row_length,
            job.off_track.to_bits(),
            job.laser[0].to_bits(),
            job.laser[1].to_bits(),
            job.longest.to_bits(),
            job.steps_per_cell.to_bits(),
        ] {
            words.extend_from_slice(&word.to_ne_bytes());
        }
        queue.write_buffer(&buffers.job, 0, &words);
        let mut encoder = device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        {
            let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
            pass.set_pipeline(match entry {
                Entry::Ranges => &self.gpu.ranges,
                Entry::Weights => &self.gpu.weights,
            });
            pass.set_bind_group(0, &buffers.group, &[]);
            pass.dispatch_workgroups(groups_x, groups.div_ceil(groups_x), 1);
        }
        let size = (count * size_of::<f32>()) as u64;
        encoder.copy_buffer_to_buffer(&buffers.result, 0, &buffers.staging, 0, size);
        let submission = queue.submit([encoder.finish()]);
        let (send, receive) = std::sync::mpsc::channel();
        buffers
            .staging
            .map_async(wgpu::MapMode::Read, 0..size, move |mapped| {
                // Nobody listens any more when the wait has ended with an error.
                send.send(mapped).ok();
            });
        let rays = count as f64 * f64::from(job.beams.max(1));
        let patience = if self.gpu.on_cpu {
            PATIENCE_ON_CPU[0] + PATIENCE_ON_CPU[1] * rays
        } else {
            PATIENCE
        };
        let wait = wgpu::PollType::Wait {
            submission_index: Some(submission),
            timeout: Some(Duration::from_secs_f64(patience)),
        };
        let fail = |fault: String| self.gpu.failed(fault);
        device.poll(wait).map_err(|error| fail(error.to_string()))?;
        self.gpu.check()?;
        receive
            .try_recv()
            .map_err(|_| fail("the results did not arrive".into()))?
            .map_err(|error| fail(error.to_string()))?;
        {
            let view = buffers.staging.get_mapped_range(0..size);
            let view = view.map_err(|error| fail(error.to_string()))?;
            let results: Vec<f32> = view
                .as_chunks::<4>()
                .0
                .iter()
                .map(|bytes| f32::from_ne_bytes(*bytes))
                .collect();
            then(&results);
        }
        buffers.staging.unmap();
        Ok(())
    }

    /// Buffers for `poses` poses, and for so many bytes of directions and rows.
    fn new_buffers(&self, poses: usize, [directions, rows]: [usize; 2]) -> Buffers {
        use wgpu::BufferUsages as Usage;
        let gpu = &self.gpu;
        // A power of two, so that a number of particles that changes costs no new buffers.
        let poses = poses.next_power_of_two().max(1024);
        let beams = [directions, rows].map(|bytes| bytes.next_power_of_two().max(64));
        let input = Usage::STORAGE | Usage::COPY_DST;
        let results = (poses * size_of::<f32>()) as u64;
        let job = gpu.buffer(48, Usage::UNIFORM | Usage::COPY_DST);
        let pose = gpu.buffer((poses * size_of::<[f32; 4]>()) as u64, input);
        let [beam, row] = beams.map(|bytes| gpu.buffer(bytes as u64, input));
        let result = gpu.buffer(results, Usage::STORAGE | Usage::COPY_SRC);
        let staging = gpu.buffer(results, Usage::MAP_READ | Usage::COPY_DST);
        let bound = [&job, &self.cells, &pose, &beam, &row, &result];
        let entries: Vec<wgpu::BindGroupEntry<'_>> = bound
            .into_iter()
            .enumerate()
            .map(|(binding, buffer)| wgpu::BindGroupEntry {
                binding: binding as u32,
                resource: buffer.as_entire_binding(),
            })
            .collect();
        let group = gpu.device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: None,
            layout: &gpu.layout,
            entries: &entries,
        });
        Buffers {
            poses,
            beams,
            job,
            pose,
            beam,
            row,
            result,
            staging,
            group,
            bytes: Vec::new(),
        }
    }
}

impl Buffers {
    /// Whether so many poses, and so many bytes of directions and rows, fit.
    fn hold(&self, poses: usize, [directions, rows]: [usize; 2]) -> bool {
        poses <= self.poses && directions <= self.beams[0] && rows <= self.beams[1]
    }
}
