//! One fixed message of each kind, and strategies for arbitrary ones.

use proptest::collection::vec;
use proptest::option;
use proptest::prelude::*;
use protocol::*;

pub(crate) const POSE: Pose2 = Pose2 {
    x: 1.5,
    y: -2.25,
    heading: 0.5,
};
pub(crate) const TWIST: Twist2 = Twist2 {
    linear_x: 4.0,
    linear_y: 0.125,
    angular: -0.5,
};
const RATES: Rates = Rates {
    pose: 1000.0,
    cloud: 10.0,
    scan: 10.0,
    health: 10.0,
    recorded: true,
};
pub(crate) const ID: CommandId = CommandId(0x0102_0304_0506_0708_090a_0b0c_0d0e_0f10);

pub(crate) const CAUSE_KINDS: [CauseKind; 43] = [
    CauseKind::NoInitialPose,
    CauseKind::NewPose,
    CauseKind::Alignment,
    CauseKind::Residual,
    CauseKind::LongBeams,
    CauseKind::Occluded,
    CauseKind::NoReturn,
    CauseKind::EffectiveSampleSize,
    CauseKind::Likelihood,
    CauseKind::SpreadAlong,
    CauseKind::SpreadAcross,
    CauseKind::SecondMode,
    CauseKind::Slip,
    CauseKind::YawRate,
    CauseKind::Innovation,
    CauseKind::Age,
    CauseKind::NoScan,
    CauseKind::NoOdometry,
    CauseKind::BadSensorData,
    CauseKind::Searching,
    CauseKind::OdometryJump,
    CauseKind::GyroInDegrees,
    CauseKind::GyroFlipped,
    CauseKind::GyroBias,
    CauseKind::GyroIgnored,
    CauseKind::GyroAlwaysZero,
    CauseKind::OdometryTurnScale,
    CauseKind::OdometryTurnBias,
    CauseKind::OdometryTurnWrong,
    CauseKind::TwistFromPose,
    CauseKind::PoseFromTwist,
    CauseKind::WheelScale,
    CauseKind::Creep,
    CauseKind::WheelsSlide,
    CauseKind::SweepFromScanTime,
    CauseKind::TimeIncrementWrong,
    CauseKind::RangeMaxWrong,
    CauseKind::AngleIncrementMissing,
    CauseKind::ScanLag,
    CauseKind::RepeatedScans,
    CauseKind::ClockStep,
    CauseKind::MapDiffers,
    CauseKind::OdometryStands,
];

pub(crate) const STATES: [State; 7] = [
    State::Init,
    State::Converging,
    State::Localized,
    State::Degraded,
    State::Lost,
    State::Relocalizing,
    State::Stale,
];

pub(crate) fn pose() -> Pose {
    Pose {
        pose: POSE,
        twist: TWIST,
        covariance: Covariance {
            xx: 0.25,
            xy: 0.0,
            xh: 0.0,
            yy: 0.5,
            yh: 0.0,
            hh: 0.125,
        },
        track: Some(TrackPoint { s: 12.0, d: -0.25 }),
        lap: 3,
        update: 77,
        kind: PoseKind::Predicted,
    }
}

pub(crate) fn cloud() -> Cloud {
    Cloud {
        update: 77,
        count: 3000,
        ess_ratio: 0.5,
        spread_along: 0.25,
        spread_across: 0.125,
        second_mode: 0.0,
        centre: [1.5, -2.25],
        particles: vec![CloudParticle {
            x: -1,
            y: 2,
            heading: 256,
            weight: 65535,
        }],
    }
}

pub(crate) fn scan_view() -> ScanView {
    let kinds = [
        EndPointKind::OnWall,
        EndPointKind::OffWall,
        EndPointKind::Short,
        EndPointKind::Long,
    ];
    ScanView {
        update: 77,
        centre: [1.5, -2.25],
        points: kinds.map(|kind| EndPoint { x: 1, y: -2, kind }).to_vec(),
    }
}

pub(crate) fn health(state: State) -> Health {
    Health {
        state,
        since: 1_000,
        causes: CAUSE_KINDS
            .map(|kind| Cause {
                kind,
                severity: Severity::Warning,
                value: Some(0.5),
                limit: None,
            })
            .to_vec(),
        update: 77,
        metrics: Some(Metrics {
            alignment: 0.75,
            particles: 3000,
            ..Metrics::default()
        }),
        proposal: Some(Proposal {
            set: "lq".into(),
            evidence: "slip".into(),
            since: 2_000,
        }),
        auto: true,
    }
}

pub(crate) fn load() -> Load {
    let latency = Latency {
        p50: 1.0,
        p99: 2.0,
        max: 4.0,
    };
    Load {
        cpu_process: 0.5,
        cpu_cores: vec![0.25, 0.75],
        memory_process: 1 << 20,
        memory_used: 1 << 30,
        memory_total: 1 << 33,
        temperature: Some(61.5),
        throttled: Some(false),
        update_us: latency,
        scan_age_us: latency,
        publish_lag_us: latency,
        scan_rate: 40.0,
        odometry_rate: 50.0,
        update_rate: 40.0,
        scan_jitter: 0.001,
        queue_depth: 1,
        drops: Drops {
            malformed: 1,
            time_backwards: 2,
            no_odometry: 3,
            stale_odometry: 4,
            no_beams: 5,
            not_initialized: 6,
            overrun: 7,
            telemetry: 8,
            payloads: 9,
        },
        recorder: Some(recorder()),
    }
}

pub(crate) fn recorder() -> RecorderState {
    RecorderState {
        recording: true,
        file: 12,
        bytes: 1 << 26,
        limit: 1 << 33,
        free: 1 << 34,
        dropped: 3,
        error: Some("full".into()),
    }
}

/// One of each kind, in the order of the wire.
pub(crate) fn files_requests() -> [FilesRequest; 3] {
    [
        FilesRequest::List { after: 11 },
        FilesRequest::Read {
            number: 12,
            offset: 65_536,
            length: 4000,
        },
        FilesRequest::Checksum {
            number: 12,
            length: 69_536,
        },
    ]
}

/// One of each kind, in the order of the wire.
pub(crate) fn files_replies() -> [FilesReply; 4] {
    [
        FilesReply::Files {
            files: vec![FileInfo {
                number: 12,
                started: 1_000,
                bytes: 69_536,
                finished: true,
            }],
            more: false,
        },
        FilesReply::Bytes {
            number: 12,
            offset: 65_536,
            bytes: vec![1, 2, 3],
        },
        FilesReply::Checksum {
            number: 12,
            length: 69_536,
            xxh3: 0x0102_0304_0506_0708,
        },
        FilesReply::Refused { fault: "gone".into() },
    ]
}

pub(crate) fn parameter_set() -> ParameterSet {
    ParameterSet {
        name: "hq".into(),
        values: vec![
            ("a".into(), Value::Bool(true)),
            ("b".into(), Value::Int(-1)),
            ("c".into(), Value::Float(0.5)),
            ("d".into(), Value::Text("tum".into())),
        ],
    }
}

pub(crate) fn shadow() -> Shadow {
    let fitness = Fitness {
        alignment: 0.75,
        residual: 0.0625,
        innovation: 0.03125,
        spread_along: 0.25,
        spread_across: 0.125,
        update_us: Latency {
            p50: 1.0,
            p99: 2.0,
            max: 4.0,
        },
    };
    Shadow {
        set: Some("lq".into()),
        who: "ana".into(),
        since: 1_000,
        comparison: Some(Comparison {
            in_force: SetRef {
                name: "hq".into(),
                revision: 5,
            },
            window: 8.0,
            scans: 320,
            skipped: 2,
            force: fitness,
            shadow: Fitness {
                alignment: 0.5,
                ..fitness
            },
            distance: 0.0625,
            distance_max: 0.125,
            angle: 0.015_625,
            force_better: 0.5,
            shadow_better: 0.25,
        }),
    }
}

pub(crate) fn params() -> Params {
    Params {
        set: parameter_set(),
        revision: 5,
        who: "ana".into(),
        when: 1_000,
        since_update: 70,
        pending_revert: Some(PendingRevert {
            to: "lq".into(),
            at: 2_000,
        }),
        available: vec!["hq".into(), "lq".into()],
    }
}

/// One of each kind, in the order of the wire.
pub(crate) fn event_kinds() -> Vec<EventKind> {
    let from = SetRef {
        name: "hq".into(),
        revision: 4,
    };
    let to = SetRef {
        name: "lq".into(),
        revision: 5,
    };
    let set = "lq".to_owned();
    let name = set.clone();
    let text = "so".to_owned();
    let update = 70;
    vec![
        EventKind::Started {
            version: "0.1.0".into(),
        },
        EventKind::Stopping { reason: text.clone() },
        EventKind::StateChanged {
            from: State::Localized,
            to: State::Lost,
            causes: health(State::Lost).causes[..1].to_vec(),
        },
        EventKind::ParametersChanged {
            from: from.clone(),
            to: to.clone(),
            update,
            revert_after: Some(30.0),
        },
        EventKind::ParametersConfirmed { set: to.clone() },
        EventKind::ParametersFellBack { from, to, update },
        EventKind::SetStored {
            name: name.clone(),
            from: "hq".into(),
            changes: vec![ValueChange {
                key: "max_particles".into(),
                before: Value::Int(3000),
                after: Value::Int(1500),
            }],
        },
        EventKind::SetDeleted { name },
        EventKind::PoseInitialized {
            before: Some(POSE),
            pose: POSE,
        },
        EventKind::SearchStarted,
        EventKind::Relocalized { pose: POSE },
        EventKind::Lap {
            lap: 2,
            time: Some(9.25),
            set: set.clone(),
        },
        EventKind::SlipStarted { slip: 0.25 },
        EventKind::SlipEnded {
            worst: 0.5,
            duration: 2.0,
        },
        EventKind::Proposed {
            set,
            evidence: text.clone(),
        },
        EventKind::AutoChanged { on: true },
        EventKind::RatesChanged {
            from: RATES,
            to: Rates { pose: 20.0, ..RATES },
        },
        EventKind::CommandRefused {
            faults: vec![text.clone()],
        },
        EventKind::SourceEnded,
        EventKind::Warning { text: text.clone() },
        EventKind::Error { text: text.clone() },
        EventKind::ShadowStarted { set: "lq".into() },
        EventKind::ShadowEnded { set: "lq".into() },
        EventKind::ShadowDropped {
            set: "lq".into(),
            evidence: text,
        },
        EventKind::RatesLowered {
            transit: 0.5,
            pose: 20.0,
            recorded: false,
        },
        EventKind::RatesRestored,
        EventKind::RecordingStarted { file: 12 },
        EventKind::RecordingEnded {
            reason: "stopped".into(),
        },
    ]
}

pub(crate) fn event(kind: EventKind) -> Event {
    Event {
        kind,
        update: 77,
        who: Some("ana".into()),
        command: Some(ID),
    }
}

pub(crate) fn recorded_scan() -> RecordedScan {
    RecordedScan {
        angle_min: -2.0,
        angle_increment: 0.25,
        time_increment: 0.0,
        range_min: 0.0625,
        range_max: 10.0,
        ranges: vec![1000, RecordedScan::NO_RETURN],
    }
}

pub(crate) fn map() -> MapReply {
    MapReply {
        name: "club".into(),
        width: 3,
        height: 2,
        resolution: 0.5,
        origin: POSE,
        runs: vec![(Cell::Free, 1), (Cell::Occupied, 3), (Cell::Unknown, 2)],
        raceline: Some(MapRaceline {
            length: 4.0,
            points: vec![[0.0, 1.0], [2.0, -1.0]],
        }),
    }
}

pub(crate) fn info() -> CarInfo {
    CarInfo {
        version: "0.1.0".into(),
        started: 1_000,
        source: "bag".into(),
        map: "club".into(),
        lap_length: Some(4.0),
        base_link_from_laser: POSE,
        host: "car".into(),
    }
}

/// One of each kind, in the order of the wire.
pub(crate) fn actions() -> Vec<Action> {
    let rates = Rates {
        pose: 40.0,
        cloud: 10.0,
        scan: 10.0,
        health: 10.0,
        recorded: true,
    };
    vec![
        Action::Params(ParamsAction::Select {
            name: "lq".into(),
            revert_after_ms: Some(30_000),
        }),
        Action::Params(ParamsAction::Put {
            set: parameter_set(),
            revert_after_ms: None,
        }),
        Action::Params(ParamsAction::Confirm),
        Action::Params(ParamsAction::Revert),
        Action::Params(ParamsAction::Delete { name: "mine".into() }),
        Action::Params(ParamsAction::List),
        Action::Pose(POSE),
        Action::Relocalize(RelocalizeAction::Search),
        Action::Relocalize(RelocalizeAction::Pick { candidate: 2 }),
        Action::Rates(RatesAction::Get),
        Action::Rates(RatesAction::Set(rates)),
        Action::Auto(true),
        Action::Params(ParamsAction::Shadow {
            name: Some("lq".into()),
        }),
        Action::Record(RecordAction::Get),
        Action::Record(RecordAction::Start),
        Action::Record(RecordAction::Stop),
    ]
}

pub(crate) fn command(action: Action) -> Command {
    Command {
        id: ID,
        operator: "ana".into(),
        expected_revision: Some(5),
        action,
    }
}

/// One of each kind, in the order of the wire.
pub(crate) fn outcomes() -> Vec<Outcome> {
    let done = |reply| Outcome::Done {
        update: Some(70),
        reply,
    };
    let Action::Rates(RatesAction::Set(rates)) = actions()[10] else {
        unreachable!("the list above has it there");
    };
    vec![
        done(Reply::Nothing),
        done(Reply::Sets(vec![StoredSet {
            set: parameter_set(),
            built_in: false,
            who: Some("ana".into()),
        }])),
        done(Reply::Candidates(vec![Candidate {
            number: 1,
            pose: POSE,
            score: 0.75,
        }])),
        done(Reply::Rates(rates)),
        done(Reply::Recorder(recorder())),
        Outcome::Refused {
            faults: vec!["so".into()],
        },
        Outcome::StaleRevision {
            expected: 4,
            who: "ben".into(),
        },
    ]
}

pub(crate) fn answer(outcome: Outcome) -> Answer {
    Answer {
        id: ID,
        outcome,
        set: SetRef {
            name: "lq".into(),
            revision: 5,
        },
    }
}

/// Messages of all kinds, encoded.
pub(crate) fn all() -> Vec<Vec<u8>> {
    fn bytes<M: Message>(message: &M) -> Vec<u8> {
        encode(message, Stamps::default()).expect("a good message")
    }
    let mut all = vec![
        bytes(&pose()),
        bytes(&cloud()),
        bytes(&scan_view()),
        bytes(&health(State::Lost)),
        bytes(&load()),
        bytes(&shadow()),
        bytes(&params()),
        bytes(&recorded_scan()),
        bytes(&map()),
        bytes(&info()),
        bytes(&ClockRequest { sent: 5 }),
        bytes(&LinkReport {
            transit: 0.5,
            uncertainty: 0.125,
            poses: 40,
        }),
        bytes(&missing_request()),
        bytes(&missing_reply()),
    ];
    all.extend(files_requests().iter().map(bytes));
    all.extend(files_replies().iter().map(bytes));
    all.extend(event_kinds().into_iter().map(|kind| bytes(&event(kind))));
    all.extend(actions().into_iter().map(|action| bytes(&command(action))));
    all.extend(outcomes().into_iter().map(|outcome| bytes(&answer(outcome))));
    all
}

/// Two streams, the first with two holes.
pub(crate) fn missing_request() -> MissingRequest {
    MissingRequest {
        run_id: 7,
        streams: vec![
            Wanted {
                topic: Topic::Event,
                ranges: vec![[1, 2], [5, 5]],
            },
            Wanted {
                topic: Topic::RecordedScan,
                ranges: Vec::new(),
            },
        ],
        budget: 6000,
    }
}

/// One message of a stream of five.
pub(crate) fn missing_reply() -> MissingReply {
    MissingReply {
        streams: vec![Kept {
            topic: Topic::Event,
            first: 1,
            last: 5,
        }],
        messages: vec![Resent {
            topic: Topic::Event,
            bytes: vec![1, 2, 3],
        }],
    }
}

pub(crate) fn any_number() -> impl Strategy<Value = f64> {
    prop_oneof![Just(0.0), Just(-0.0), Just(f64::MAX), -1e3..1e3]
}

pub(crate) fn any_single() -> impl Strategy<Value = f32> {
    prop_oneof![Just(0.0f32), Just(f32::MIN_POSITIVE), -1e3f32..1e3]
}

pub(crate) fn any_pose2() -> impl Strategy<Value = Pose2> {
    (any_number(), any_number(), any_number()).prop_map(|(x, y, heading)| Pose2 { x, y, heading })
}

fn any_twist() -> impl Strategy<Value = Twist2> {
    (any_number(), any_number(), any_number()).prop_map(|(linear_x, linear_y, angular)| Twist2 {
        linear_x,
        linear_y,
        angular,
    })
}

pub(crate) fn any_pose() -> impl Strategy<Value = Pose> {
    let track = (any_number(), any_number()).prop_map(|(s, d)| TrackPoint { s, d });
    let kind = prop_oneof![Just(PoseKind::Updated), Just(PoseKind::Predicted)];
    let covariance = [
        any_single(),
        any_single(),
        any_single(),
        any_single(),
        any_single(),
        any_single(),
    ];
    (
        any_pose2(),
        any_twist(),
        covariance,
        option::of(track),
        any::<(u32, u64)>(),
        kind,
    )
        .prop_map(
            |(pose, twist, [xx, xy, xh, yy, yh, hh], track, (lap, update), kind)| Pose {
                pose,
                twist,
                covariance: Covariance {
                    xx,
                    xy,
                    xh,
                    yy,
                    yh,
                    hh,
                },
                track,
                lap,
                update,
                kind,
            },
        )
}

pub(crate) fn any_cloud() -> impl Strategy<Value = Cloud> {
    let particle = any::<(i16, i16, i16, u16)>().prop_map(|(x, y, heading, weight)| CloudParticle {
        x,
        y,
        heading,
        weight,
    });
    let particles = vec(particle, 0..=Cloud::MAX_PARTICLES);
    let shares = [0.0f32..=1.0, 0.0f32..=1.0];
    (
        any::<(u64, u32)>(),
        shares,
        [any_single(), any_single()],
        [any_number(), any_number()],
        particles,
    )
        .prop_map(
            |((update, count), [ess_ratio, second_mode], [along, across], centre, particles)| Cloud {
                update,
                count,
                ess_ratio,
                spread_along: along,
                spread_across: across,
                second_mode,
                centre,
                particles,
            },
        )
}

pub(crate) fn any_health() -> impl Strategy<Value = Health> {
    let cause = (
        prop::sample::select(CAUSE_KINDS.to_vec()),
        prop_oneof![
            Just(Severity::Info),
            Just(Severity::Warning),
            Just(Severity::Critical)
        ],
        option::of(any_single()),
        option::of(any_single()),
    )
        .prop_map(|(kind, severity, value, limit)| Cause {
            kind,
            severity,
            value,
            limit,
        });
    let metrics = (0.0f32..=1.0, any_single(), any::<u32>()).prop_map(|(share, number, particles)| Metrics {
        alignment: share,
        short_beams: 1.0 - share,
        residual: number,
        slip: -number,
        particles,
        ..Metrics::default()
    });
    let proposal = (".{0,40}", ".{0,40}", any::<i64>()).prop_map(|(set, evidence, since)| Proposal {
        set,
        evidence,
        since,
    });
    (
        prop::sample::select(STATES.to_vec()),
        any::<(i64, u64, bool)>(),
        vec(cause, 0..=Health::MAX_CAUSES),
        option::of(metrics),
        option::of(proposal),
    )
        .prop_map(
            |(state, (since, update, auto), causes, metrics, proposal)| Health {
                state,
                since,
                causes,
                update,
                metrics,
                proposal,
                auto,
            },
        )
}

pub(crate) fn any_set() -> impl Strategy<Value = ParameterSet> {
    let value = prop_oneof![
        any::<bool>().prop_map(Value::Bool),
        any::<i64>().prop_map(Value::Int),
        any_number().prop_map(Value::Float),
        ".{0,20}".prop_map(Value::Text),
    ];
    (
        "[a-z0-9-]{1,64}",
        prop::collection::btree_map("[a-z_]{1,12}", value, 0..40),
    )
        .prop_map(|(name, values)| ParameterSet {
            name,
            values: values.into_iter().collect(),
        })
}

pub(crate) fn any_command() -> impl Strategy<Value = Command> {
    let params = prop_oneof![
        ("[a-z0-9-]{1,64}", any::<Option<u32>>()).prop_map(|(name, revert_after_ms)| {
            ParamsAction::Select {
                name,
                revert_after_ms,
            }
        }),
        (any_set(), any::<Option<u32>>())
            .prop_map(|(set, revert_after_ms)| { ParamsAction::Put { set, revert_after_ms } }),
        Just(ParamsAction::Confirm),
        Just(ParamsAction::Revert),
        "[a-z0-9-]{1,64}".prop_map(|name| ParamsAction::Delete { name }),
        Just(ParamsAction::List),
        option::of("[a-z0-9-]{1,64}").prop_map(|name| ParamsAction::Shadow { name }),
    ];
    let action = prop_oneof![
        params.prop_map(Action::Params),
        any_pose2().prop_map(Action::Pose),
        Just(Action::Relocalize(RelocalizeAction::Search)),
        any::<u32>().prop_map(|candidate| Action::Relocalize(RelocalizeAction::Pick { candidate })),
        any::<bool>().prop_map(Action::Auto),
    ];
    (any::<u128>(), "[a-z]{1,64}", any::<Option<u64>>(), action).prop_map(
        |(id, operator, expected_revision, action)| Command {
            id: CommandId(id),
            operator,
            expected_revision,
            action,
        },
    )
}

pub(crate) fn any_scan() -> impl Strategy<Value = RecordedScan> {
    (
        [
            any_number(),
            any_number(),
            any_number(),
            any_number(),
            any_number(),
        ],
        vec(any::<u16>(), 0..1500),
    )
        .prop_map(
            |([angle_min, angle_increment, time_increment, range_min, range_max], ranges)| RecordedScan {
                angle_min,
                angle_increment,
                time_increment,
                range_min,
                range_max,
                ranges,
            },
        )
}
