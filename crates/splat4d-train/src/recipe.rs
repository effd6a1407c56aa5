//! The recipe: every knob of a run, typed, with the names users of splatting systems know. It is TOML on disk; the
//! effective one is saved with the run, and a run repeats bit for bit from it (on the same SIMD level).
//!
//! Learning rates of positions are in units of the scene's extent; everything with time in it is stated per clip length.
//! Iteration knobs left at 0 follow from `iterations` (see [`Recipe::resolve`]).

use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use splat4d::motion::filtered::{Fusion, MAX_BASELINE, MAX_HISTORY, Predictor};
use splat4d::motion::native4d::MAX_HARMONICS;

macro_rules! recipe {
    ($($(#[doc = $doc:literal])* $name:ident : $t:ty = $default:expr,)*) => {
        /// All knobs. See the fields.
        #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
        #[serde(default, deny_unknown_fields)]
        pub struct Recipe { $($(#[doc = $doc])* pub $name: $t,)* }

        impl Default for Recipe {
            fn default() -> Self { Self { $($name: $default,)* } }
        }

        impl Recipe {
            /// Name, default and documentation of every knob, in order.
            pub fn knobs() -> Vec<Knob> {
                vec![$(Knob {
                    name: stringify!($name),
                    default: toml::Value::try_from::<$t>($default).map(|v| v.to_string()).unwrap_or_default(),
                    doc: [$($doc),*].concat().trim().to_owned(),
                }),*]
            }
        }
    };
}

/// Default of `near`: a camera that is mounted in a wall looks through the wall's own splats, and haze in
/// front of places where no training camera stands costs nothing. PanopticSports basketball, four minutes, held-out
/// cameras: 27.1 dB with 0.05 (Kerbl et al. 2023 draw nothing nearer than 0.2 units, about that share), 28.1 with this.
pub const NEAR: f64 = 0.2;
/// What `features` is where Gaussians have some.
pub const FULL: &str = "full";
/// What `control_trajectory` may be.
pub const TRAJECTORIES: [&str; 5] = ["spline", "linear", "slerp", "low-rank", "network"];
/// What `prune_score` may be: the names of `upkeep::worth::Spatial`.
pub const PRUNE_SCORES: [&str; 7] = ["share", "change", "both", "opacity", "light-gaussian", "pup", "speedy"];
/// Opacity below which MCMC relocates (Kheradmand et al. 2024).
const MCMC_DEAD_OPACITY: f64 = 0.005;
/// Opacity below which ADC prunes: four times the original's, +0.5 dB in a 1,500-step comparison on the bundled
/// capture.
const ADC_DEAD_OPACITY: f64 = 0.02;

/// One knob, for help and for the nearest-name suggestion.
#[derive(Clone, Debug)]
pub struct Knob {
    /// Its name in TOML and in `--set`.
    pub name: &'static str,
    /// Its default, as TOML.
    pub default: String,
    /// What it does.
    pub doc: String,
}

recipe! {
    /// Motion model: still, spacetime, deform-mlp, hexplane, tracked, native4d, control or ssm; auto: chosen by what the capture is.
    motion: String = "spacetime".into(),
    /// Seed of every random choice.
    seed: u64 = 0,
    /// Training steps in all.
    iterations: usize = 7000,
    /// Views a step.
    batch_size: usize = 1,
    /// Images are reduced by this factor (mean of k×k boxes).
    downscale: usize = 1,
    /// Held-out views: empty (the data set's own convention), "camera=0,10", "every=8" or "none".
    hold_out: String = String::new(),
    /// Frames a second; 0: as the capture says.
    fps: f64 = 0.0,
    /// Only this many frames of the take; 0: all.
    max_frames: usize = 0,
    /// How near to a camera Gaussians are drawn, of the extent; less where the capture's points come nearer, a quarter of it
    /// where there are none.
    near: f64 = NEAR,
    /// First frame of the take that is used.
    first_frame: usize = 0,
    /// RGBA captures composite on white; false: on black.
    white_background: bool = true,
    /// Highest degree of the spherical harmonics, 0 to 3.
    sh_degree: usize = 1,
    /// Iterations before each further SH degree is unlocked; 0: iterations/10.
    sh_degree_interval: usize = 0,
    /// Share of the iterations, from the first, that see pictures at half size.
    half_size_until: f64 = 0.4,
    /// Share of D-SSIM in the photometric loss.
    lambda_dssim: f64 = 0.2,
    /// Weight of the alpha-mask loss |alpha − mask| where masks cover the whole scene (RGBA captures).
    lambda_mask: f64 = 0.0,
    /// Where Gaussians start: "auto", "points", "hull", "random", or a .ply file.
    init: String = "auto".into(),
    /// Initial Gaussians. Points that a capture lacks to so many are laid between its own, along surfaces; the hull of masks and
    /// random points bring as many of their own.
    num_pts: usize = 10_000,
    /// Initial opacity.
    init_opacity: f64 = 0.1,
    /// Moments at which initial points are spread over the clip; 0: about every 5 frames.
    init_keyframes: usize = 0,
    /// Rate of positions at the start, of the extent.
    position_lr_init: f64 = 2e-3,
    /// Rate of positions at the end, of the extent.
    position_lr_final: f64 = 5e-5,
    /// Rates that are not given two ends (colour, opacity, scale, rotation, life) fall to this share of themselves.
    lr_decay: f64 = 1.0,
    /// Rate of base colour; the higher SH degrees learn 20 times slower.
    feature_lr: f64 = 6e-3,
    /// Rate of opacity logits.
    opacity_lr: f64 = 0.05,
    /// Rate of log scales.
    scaling_lr: f64 = 0.015,
    /// Rate of quaternions.
    rotation_lr: f64 = 1e-3,
    /// spacetime: order of the motion polynomial, 0 to 3.
    motion_order: usize = 1,
    /// spacetime: whether quaternions turn with time.
    rotation_rate: bool = false,
    /// The life of a Gaussian: auto (spacetime gauss-half, others infinite), infinite, gauss-half, gauss-one, interval.
    life: String = "auto".into(),
    /// spacetime: life's centre learns from opacity alone (STG).
    detach: bool = false,
    /// spacetime: rate of velocities at the start, extents a clip.
    velocity_lr_init: f64 = 5e-3,
    /// spacetime: rate of velocities at the end, extents a clip.
    velocity_lr_final: f64 = 1.6e-5,
    /// spacetime: rate of quaternion rates, 1/clip.
    rotation_rate_lr: f64 = 1e-3,
    /// spacetime: features beside the base colour, which a small network turns into colour pixel by pixel: none or full (the
    /// full model of STG; takes the place of spherical harmonics, so that sh_degree becomes 0). Such scenes are drawn by
    /// splat4d alone: they have no playback file and no export.
    features: String = "none".into(),
    /// spacetime: rate of view features (STG, 30,000 steps: 0.0025).
    view_features_lr: f64 = 0.01,
    /// spacetime: rate of time features, 1/clip (STG: 0.001).
    time_features_lr: f64 = 0.02,
    /// spacetime: rate of the network's weights (STG: 0.0001).
    head_lr: f64 = 3e-3,
    /// life: rate of life centres, clips.
    life_center_lr: f64 = 1e-3,
    /// life: rate of log life widths.
    life_width_lr: f64 = 0.01,
    /// life: initial life width of moving points, clips; 0: twice the gap between keyframes.
    init_life: f64 = 0.0,
    /// life: life widths never fall below this many frames.
    min_life_frames: f64 = 0.5,
    // deform-mlp.
    /// deform-mlp: network: mlp (8x256), small, hash (grids and a small network) or hash-linear; auto: hash where cameras
    /// are fixed, small where all move and a moment is seen once.
    deform_trunk: String = "auto".into(),
    /// deform-mlp: width of the small and hash networks.
    deform_width: usize = 128,
    /// deform-mlp: hidden layers of the small and hash networks.
    deform_layers: usize = 2,
    /// deform-mlp: levels of the positional encoding of places (the published 10 suits mlp).
    deform_x_levels: usize = 4,
    /// deform-mlp: levels of the positional encoding of time (published: 6 with deform_time_net, else 10).
    deform_t_levels: usize = 3,
    /// deform-mlp: whether time goes through a small network of its own first (published for synthetic scenes).
    deform_time_net: bool = false,
    /// deform-mlp: positions move by screw motions (6 degrees of freedom) instead of offsets.
    deform_rigid: bool = false,
    /// deform-mlp: rate of networks at the start; hash grids learn 50 times faster.
    deform_lr_init: f64 = 2e-3,
    /// deform-mlp: rate of networks at the end.
    deform_lr_final: f64 = 1e-4,
    /// deform-mlp: share of the iterations that fit the cloud alone before networks learn.
    deform_warmup: f64 = 0.05,
    /// deform-mlp: share of the iterations after which every level of the hash grids learns; 0: all at once.
    deform_unlock: f64 = 0.3,
    /// deform-mlp: annealed smoothing noise on time at the start, frames; it is zero by half the iterations. 0.1 for real
    /// captures with uncertain poses.
    deform_time_noise: f64 = 0.0,

    // hexplane.

    /// hexplane: steps of the coarse stage, in which nothing moves; 0: iterations/10.
    coarse_iterations: usize = 0,
    /// hexplane: features a level of the planes; a multiple of 16.
    plane_channels: usize = 32,
    /// hexplane: grid points of a plane along a spatial axis, at multiple 1.
    plane_resolution: usize = 64,
    /// hexplane: grid points of a plane along time; 0: one every 4 frames, at least 8.
    time_resolution: usize = 0,
    /// hexplane: levels of the planes, as multiples of the resolution.
    multires: Vec<usize> = vec![1, 2],
    /// hexplane: steps of the fine stage before each further level is unlocked; 0: all at once.
    unlock_interval: usize = 0,
    /// hexplane: width of the networks.
    net_width: usize = 64,
    /// hexplane: linear maps between planes and heads; 0 is 1.
    defor_depth: usize = 0,
    /// hexplane: positions do not move.
    no_dx: bool = false,
    /// hexplane: scales do not change.
    no_ds: bool = false,
    /// hexplane: rotations do not change.
    no_dr: bool = false,
    /// hexplane: opacities do not change.
    no_do: bool = true,
    /// hexplane: colours do not change.
    no_dshs: bool = true,
    /// hexplane: rate of the planes at the start.
    grid_lr_init: f64 = 2e-2,
    /// hexplane: rate of the planes at the end.
    grid_lr_final: f64 = 2e-3,
    /// hexplane: rate of the networks at the start.
    deformation_lr_init: f64 = 1e-3,
    /// hexplane: rate of the networks at the end.
    deformation_lr_final: f64 = 1e-4,
    /// hexplane: weight of the squared second differences of the planes over space.
    plane_tv_weight: f64 = 1e-4,
    /// hexplane: weight of the squared second differences of the time planes along time.
    time_smoothness_weight: f64 = 0.01,
    /// hexplane: weight of the mean distance of the time planes from 1, where nothing depends on time.
    l1_time_planes: f64 = 1e-4,
    /// hexplane: weight of the squared first differences (total variation) of the planes over space.
    plane_variation_weight: f64 = 0.0,

    // tracked.

    /// tracked: share of the iterations that frame 0 gets; the other frames share the rest.
    first_share: f64 = 0.25,
    /// tracked: rate of a frame's positions at its first step, of the extent.
    track_lr_init: f64 = 3e-3,
    /// tracked: rate of a frame's positions at its last step, of the extent.
    track_lr_final: f64 = 4e-4,
    /// tracked: rate of a frame's quaternions.
    track_rotation_lr: f64 = 6e-3,
    /// tracked: rate of base colours after frame 0. Colours are shared: frames tracked before change with them.
    track_feature_lr: f64 = 0.0,
    /// tracked: longest step that a Gaussian carries on to the next frame, of the extent.
    velocity_cap: f64 = 0.05,
    /// tracked: neighbours that each Gaussian is tied to.
    rigid_neighbours: usize = 20,
    /// tracked: a neighbour at distance d counts exp(−β d²), β in 1/(scene units)²; 0: 1/median(d²).
    rigid_beta: f64 = 0.0,
    /// tracked: weight of neighbours keeping their offsets.
    rigid: f64 = 4.0,
    /// tracked: weight of neighbours turning alike.
    rot: f64 = 4.0,
    /// tracked: weight of neighbours keeping frame 0's distances.
    iso: f64 = 2.0,
    /// tracked: weight of the background staying (with masks).
    bg: f64 = 20.0,
    /// tracked: weight of masks against what Gaussians say of the foreground; 0: all is foreground.
    seg: f64 = 3.0,
    /// tracked: weight of colours staying as they were, where they learn.
    soft_col_cons: f64 = 0.01,
    /// tracked: weight of the foreground staying above the floor.
    floor: f64 = 2.0,
    /// tracked: height of the floor along the scene's up direction, scene units; empty: no floor.
    floor_height: String = String::new(),

    // native4d, spacetime.
    /// native4d: rate at the start of the two quaternions of its rotation: they turn space, and against each other they are
    /// the velocity (1 is two extents a clip).
    rotation_4d_lr_init: f64 = 2.5e-3,
    /// native4d: the same at the end.
    rotation_4d_lr_final: f64 = 2.5e-4,
    /// native4d: blocks of spherical harmonics that change with time as cos(2πn(centre − t)/clip), 0 to 2.
    sh_harmonics: usize = 0,
    /// native4d: whether the parts of a split also lie apart in time and live shorter.
    split_time: bool = true,
    /// adc: whether the centre of a clone's life is drawn anew from the clip (STG).
    retime_clones: bool = false,
    /// spacetime: share of the iterations after which Gaussians are added where pictures are worst, along the rays of
    /// their worst patches (STG); 0: never.
    guided_from: f64 = 0.0,
    /// spacetime: times that this is done, up to the end of densification.
    guided_times: usize = 3,
    /// spacetime: most Gaussians that each of them adds, a share of those that are there.
    guided_share: f64 = 0.03,
    /// Iterations between relocations of the faintest Gaussians (FreeTimeGS takes 100), whatever the strategy; 0: never.
    relocate_interval: usize = 0,
    /// First iteration that relocates; 0: iterations/15.
    relocate_from_iter: usize = 0,
    /// Opacity below which a Gaussian is relocated.
    relocate_opacity: f64 = 0.02,
    /// Most of the Gaussians that are relocated at once, a share.
    relocate_share: f64 = 0.015,

    // control.

    /// control, ssm: control nodes at the start.
    control_nodes: usize = 512,
    /// control, ssm: nodes that pull each Gaussian, 1 to 8.
    control_neighbours: usize = 3,
    /// control, ssm: hyper coordinates, by which touching parts that move differently come apart.
    control_hyper: usize = 2,
    /// control, ssm: whether every Gaussian learns how far it follows its nodes.
    control_mask: bool = false,
    /// control: what drives the nodes: spline, linear, slerp, low-rank or network.
    control_trajectory: String = "spline".into(),
    /// control: keys of a trajectory in time; 0: about every 12 frames.
    control_keys: usize = 0,
    /// control: motions that nodes of a low-rank trajectory share.
    control_bases: usize = 16,
    /// control: width of the hidden layers of a network.
    control_width: usize = 128,
    /// control: hidden layers of a network.
    control_layers: usize = 4,
    /// control: rate of node shifts at the start, extents.
    control_shift_lr_init: f64 = 5e-4,
    /// control: rate of node shifts at the end, extents.
    control_shift_lr_final: f64 = 1e-5,
    /// control: rate of node quaternions at the start.
    control_turn_lr_init: f64 = 2e-3,
    /// control: rate of node quaternions at the end.
    control_turn_lr_final: f64 = 5e-5,
    /// control: rate of a network's weights at the start.
    control_network_lr_init: f64 = 1e-3,
    /// control: rate of a network's weights at the end.
    control_network_lr_final: f64 = 2e-5,
    /// control, ssm: rate of node positions at rest, extents.
    control_node_lr: f64 = 1e-4,
    /// control, ssm: rate of node log radii and weight logits.
    control_weight_lr: f64 = 5e-3,
    /// control, ssm: rate of hyper coordinates, extents.
    control_hyper_lr: f64 = 1e-4,
    /// control, ssm: rate of motion masks' logits.
    control_mask_lr: f64 = 0.02,
    /// control, ssm: iterations between refreshes of the lists of nearest nodes.
    control_bind_interval: usize = 100,
    /// control, ssm: iterations between additions and removals of nodes, while Gaussians densify; 0: never.
    control_adapt_interval: usize = 0,
    /// control, ssm: mean 2D gradient of a node's Gaussians above which it gets a second one (NDC units).
    control_grad_threshold: f64 = 4e-4,
    /// control, ssm: never more nodes than this.
    control_max_nodes: usize = 1024,
    /// control, ssm: weight of nodes moving as rigidly as possible.
    lambda_node_arap: f64 = 0.0,
    /// control, ssm: weight of neighbouring nodes keeping their distance.
    lambda_node_elastic: f64 = 0.0,
    /// control, ssm: weight of nodes' acceleration.
    lambda_node_acceleration: f64 = 0.0,
    /// control, ssm: weight of the mean motion mask.
    lambda_motion_mask: f64 = 0.01,
    /// control: weight of the sparsity of a low-rank trajectory.
    lambda_sparse: f64 = 0.0,

    // ssm.
    /// ssm: ticks of the scan over the clip; 0: one every ten distinct times, 16 to 96.
    ssm_ticks: usize = 0,
    /// ssm: channels.
    ssm_width: usize = 32,
    /// ssm: complex states a channel.
    ssm_states: usize = 8,
    /// ssm: residual blocks.
    ssm_blocks: usize = 2,
    /// ssm: bidirectional (to reconstruct) or causal (to forecast).
    ssm_mode: String = "bidirectional".into(),
    /// ssm: absolute (poses) or twist (rates of poses, composed from tick to tick).
    ssm_output: String = "absolute".into(),
    /// ssm: none, frames (the model turns with the scene) or vector (and mirrors with it).
    ssm_equivariance: String = "none".into(),
    /// ssm: share of the iterations, from the first, in which nothing moves; nodes are placed after it.
    ssm_warm_up: f64 = 0.0,
    /// ssm: rate of the network's maps at the start.
    ssm_lr_init: f64 = 5e-4,
    /// ssm: rate of the network's maps at the end.
    ssm_lr_final: f64 = 1e-5,
    /// ssm: rate of the state space's decays, frequencies and steps.
    ssm_dynamics_lr: f64 = 5e-4,
    /// ssm: rate of the nodes' embeddings.
    ssm_embedding_lr: f64 = 3e-2,

    // filtered.
    /// filter: how prediction and the motion's answer merge: off, geodesic (a learnt share) or literal (as published).
    filter: String = "off".into(),
    /// filter, transport: how shapes go on: wasserstein (log and exp), euclidean (numbers go straight) or hold (stay).
    filter_predictor: String = "wasserstein".into(),
    /// filter: share of the iterations after which it is switched on.
    filter_start: f64 = 0.2,
    /// filter: share of the motion's answer that Gaussians start with; the rest is the prediction's.
    filter_gain: f64 = 0.5,
    /// filter: rate of the gains' logits.
    filter_lr: f64 = 0.01,
    /// filter: frames between the two states that a velocity is taken from.
    filter_baseline: usize = 1,
    /// filter: frames of history that it runs through before every answer; 0: it predicts from the motion's own answers.
    filter_history: usize = 0,
    /// filter: squared Mahalanobis distance at which a prediction is dropped; 0: never.
    filter_gate: f64 = 11.3,
    /// filter: whether the gradient stops at earlier frames.
    filter_stop_gradient: bool = true,
    /// filter: whether the finished scene keeps the filter; else the motion alone is saved, which plays faster.
    filter_keep: bool = false,
    /// transport: distances over time that training keeps small: off, linear (means) or wasserstein (Gaussians).
    transport: String = "off".into(),
    /// transport: weight of small motion (first order), per squared extent.
    transport_temporal: f64 = 0.0,
    /// transport: weight of constant velocity (second order), per squared extent.
    transport_second: f64 = 10.0,
    /// transport: weight of drawing what is seen to what was predicted, per squared extent.
    transport_align: f64 = 0.0,
    /// transport: what shapes count for, against positions.
    transport_covariance: f64 = 100.0,
    /// transport: share of the steps that look at three frames.
    transport_every: f64 = 0.25,
    /// transport: share of a stage after which it begins.
    transport_start: f64 = 0.2,
    /// transport: share of a stage over which it grows to its weight.
    transport_ramp: f64 = 0.13,

    // Losses.

    /// Weight of the σ-weighted opacity regulariser (FreeTimeGS).
    lambda_opacity_life: f64 = 0.0,
    /// Weight of the velocity smoothness over nearest neighbours, (extents a clip)²; any model that moves.
    lambda_velocity: f64 = 0.0,
    /// Weight of local rigidity over a frame, extents: neighbours keep their offsets (Luiten et al.; they take 4).
    lambda_rigid: f64 = 0.0,
    /// Weight of the agreement of Gaussians' turns with their neighbourhood's over a frame (Luiten et al.; they take 4).
    lambda_rot: f64 = 0.0,
    /// Weight of isometry between two instants, extents: neighbours keep their distances (Luiten et al.; they take 2).
    lambda_iso: f64 = 0.0,
    /// Weight of the as-rigid-as-possible energy between two instants, extents² (SC-GS).
    lambda_arap: f64 = 0.0,
    /// Weight of the variance of neighbours' distances over four frames, over itself (SC-GS; 1e-3 there).
    lambda_elastic: f64 = 0.0,
    /// Weight of the third difference of positions over four frames, extents: against jitter.
    lambda_jerk: f64 = 0.0,
    /// Weight of the total variation of the picture's colours.
    lambda_tv: f64 = 0.0,
    /// Weight of the edge-aware total variation of depth, over its mean.
    lambda_depth_tv: f64 = 0.0,
    /// Weight of the agreement of depth with the splats' shortest axes (2DGS; 0.05 there).
    lambda_depth_normal: f64 = 0.0,
    /// Weight of the discrepancy of amplitudes and phases of the spectrum, coarse ones first (FreGS).
    lambda_frequency: f64 = 0.0,
    /// Weight of the entropy of the drawn alpha, nats: pixels decide between scene and background.
    lambda_mask_entropy: f64 = 0.0,
    /// Weight of the entropy of opacities, nats: Gaussians are there or not (SuGaR; 0.1 there).
    lambda_opacity_entropy: f64 = 0.0,
    /// Weight of the drawn flow against a known one, shares of the picture's longer side (capture.json: `flow`).
    lambda_flow: f64 = 0.0,
    /// Densification: adc, mcmc or none.
    strategy: String = "adc".into(),
    /// Never more Gaussians than this.
    max_cap: usize = 30_000,
    /// Iterations between densifications; 0: iterations/60, at least 50.
    densification_interval: usize = 0,
    /// First iteration that densifies; 0: iterations/20.
    densify_from_iter: usize = 0,
    /// Last iteration that densifies; 0: 3/4 of iterations.
    densify_until_iter: usize = 0,
    /// adc: mean 2D gradient above which a Gaussian is cloned or split (NDC units).
    densify_grad_threshold: f64 = 2e-4,
    /// adc: Gaussians larger than this share of the extent are split, smaller ones cloned.
    percent_dense: f64 = 0.01,
    /// adc: iterations between opacity resets; 0: never (a reset destroys temporal models).
    opacity_reset_interval: usize = 0,
    /// Opacity below which a Gaussian is dead; 0: 0.02 for adc, 0.005 for mcmc.
    min_opacity: f64 = 0.0,
    /// Iterations between prunings by worth in space and time (4DGS-1K), whatever the strategy; 0: never.
    prune_interval: usize = 0,
    /// Share of the Gaussians that each such pruning removes.
    prune_ratio: f64 = 0.3,
    /// Training views that each such pruning looks at; never fewer than one at every moment of the capture.
    prune_views: usize = 60,
    /// What such a pruning goes by: share, change, both, opacity, light-gaussian, pup or speedy.
    prune_score: String = "change".into(),
    // Merging, splitting into layers.
    /// What becomes of two Gaussians in one place: none (both stay), merge (one with the moments of both), prune (the
    /// fainter one goes).
    crowding: String = "none".into(),
    /// Iterations between two looks for such pairs; 0: never.
    crowding_interval: usize = 500,
    /// Largest distance of such a pair, of the smaller one's standard deviation.
    crowding_distance: f64 = 0.3,
    /// Gaussians that move less than this become a still layer of their own, of the extent; 0: never.
    static_split: f64 = 0.0,
    /// When they do, as a share of the last stage.
    static_split_from: f64 = 0.75,

    /// mcmc: growth a densification, up to the cap.
    growth: f64 = 1.05,
    /// mcmc: strength of the position noise.
    noise_lr: f64 = 5e5,
    /// Share of the 2D gradient (against opacity) in where relocated Gaussians go (FreeTimeGS).
    relocate_gradient: f64 = 0.5,
    /// Weight of the mean opacity.
    opacity_reg: f64 = 0.01,
    /// Weight of the mean scale.
    scale_reg: f64 = 0.01,
    /// Learn a gain and an offset a camera and channel, where there is more than one camera; their mean stays the identity.
    exposure: bool = true,
    /// Rate of the exposure (Luiten et al., 10,000 steps: 1e-4).
    exposure_lr: f64 = 1e-3,
    /// Antialiased mode (opacity compensation).
    antialias: bool = false,
    /// Iterations between checkpoints; 0: iterations/10.
    checkpoint_interval: usize = 0,
    /// Bytes of decoded images kept.
    image_memory: u64 = 1 << 30,
    /// Bytes that training may take in all; 0: no limit. Checked before the start, then kept by the cap.
    memory_limit: u64 = 0,
}

impl Recipe {
    /// Reads TOML. Errors: syntax, an unknown key (with the nearest known one), a wrong type or range.
    pub fn from_toml(text: &str) -> Result<Self> {
        let table: toml::Table = toml::from_str(text).map_err(|e| {
            Error::input(format!("the recipe is not valid TOML: {}", e.message()))
                .remedy("Write lines such as `iterations = 3000`; `splat4d train --help` lists the knobs")
        })?;
        let mut recipe = Self::default();
        for (key, value) in &table {
            recipe = recipe.with(key, value.clone())?;
        }
        recipe.check()?;
        Ok(recipe)
    }

    /// As TOML; reading it back gives the same recipe.
    pub fn to_toml(&self) -> String {
        toml::to_string(self).expect("a recipe is plain numbers, flags and strings")
    }

    /// Applies one `key=value`, as `--set` takes it. Strings need no quotes.
    pub fn set(&mut self, assignment: &str) -> Result<()> {
        let (key, text) = assignment.split_once('=').ok_or_else(|| {
            Error::input(format!("`{assignment}` is not of the form key=value"))
                .remedy("For instance --set iterations=300")
        })?;
        let text = text.trim();
        let value = toml::from_str::<toml::Table>(&format!("v = {text}"))
            .ok()
            .and_then(|mut t| t.remove("v"))
            .unwrap_or_else(|| toml::Value::String(text.to_owned()));
        let next = self.with(key.trim(), value)?;
        next.check()?;
        *self = next;
        Ok(())
    }

    fn with(&self, key: &str, value: toml::Value) -> Result<Self> {
        let mut table = toml::Table::try_from(self).expect("a recipe is a TOML table");
        let Some(old) = table.get(key) else {
            let names: Vec<&str> = Self::knobs().iter().map(|k| k.name).collect();
            let near = nearest(key, &names);
            return Err(Error::input(format!("`{key}` is not a knob of the recipe"))
                .remedy(near.map_or("`splat4d train --help` lists them".into(), |n| format!("Did you mean `{n}`?"))));
        };
        // Whole numbers are welcome where a fraction is expected, and 3e3 where a whole number is.
        let value = match (old, value) {
            (toml::Value::Float(_), toml::Value::Integer(i)) => toml::Value::Float(i as f64),
            (toml::Value::Integer(_), toml::Value::Float(f)) if f.fract() == 0.0 && f.abs() < 9e15 => {
                toml::Value::Integer(f as i64)
            }
            // A word may look like a number: `floor_height=0.3`.
            (toml::Value::String(_), toml::Value::Integer(i)) => toml::Value::String(i.to_string()),
            (toml::Value::String(_), toml::Value::Float(f)) => toml::Value::String(f.to_string()),
            (_, v) => v,
        };
        let expected = old.type_str();
        let shown = value.to_string();
        table.insert(key.to_owned(), value);
        table.try_into().map_err(|_| {
            Error::input(format!("knob `{key}` cannot be {shown}"))
                .remedy(format!("It takes a value of type {expected}"))
        })
    }

    /// Ranges. Errors name the knob.
    pub fn check(&self) -> Result<()> {
        let bad = |knob: &str, value: String, need: &str| {
            Err(Error::input(format!("knob `{knob}` cannot be {value}")).remedy(format!("It must be {need}")))
        };
        let positive = [
            ("position_lr_init", self.position_lr_init),
            ("position_lr_final", self.position_lr_final),
            ("feature_lr", self.feature_lr),
            ("opacity_lr", self.opacity_lr),
            ("scaling_lr", self.scaling_lr),
            ("rotation_lr", self.rotation_lr),
            ("velocity_lr_init", self.velocity_lr_init),
            ("velocity_lr_final", self.velocity_lr_final),
            ("rotation_4d_lr_init", self.rotation_4d_lr_init),
            ("rotation_4d_lr_final", self.rotation_4d_lr_final),
            ("growth", self.growth),
            ("lr_decay", self.lr_decay),
        ];
        for (knob, value) in positive {
            if !(value > 0.0 && value.is_finite()) {
                return bad(knob, value.to_string(), "a positive number");
            }
        }
        // No knob has a meaning below zero.
        for (knob, value) in toml::Table::try_from(self).expect("a recipe is a TOML table") {
            if value.as_float().is_some_and(|x| !(x >= 0.0 && x.is_finite())) {
                return bad(&knob, value.to_string(), "zero or a positive number");
            }
        }
        let shares = [
            ("lambda_dssim", self.lambda_dssim),
            ("half_size_until", self.half_size_until),
            ("relocate_gradient", self.relocate_gradient),
            ("min_opacity", self.min_opacity),
            ("prune_ratio", self.prune_ratio),
            ("ssm_warm_up", self.ssm_warm_up),
            ("static_split_from", self.static_split_from),
            ("deform_warmup", self.deform_warmup),
            ("deform_unlock", self.deform_unlock),
            ("relocate_opacity", self.relocate_opacity),
            ("relocate_share", self.relocate_share),
            ("guided_from", self.guided_from),
            ("guided_share", self.guided_share),
            ("filter_start", self.filter_start),
            ("transport_every", self.transport_every),
            ("transport_start", self.transport_start),
            ("transport_ramp", self.transport_ramp),
        ];
        for (knob, value) in shares {
            if !(0.0..=1.0).contains(&value) {
                return bad(knob, value.to_string(), "between 0 and 1");
            }
        }
        for (knob, value) in [("init_opacity", self.init_opacity), ("filter_gain", self.filter_gain)] {
            if !(value > 0.0 && value < 1.0) {
                return bad(knob, value.to_string(), "above 0 and below 1");
            }
        }
        if !(0.0..1.0).contains(&self.near) {
            return bad("near", self.near.to_string(), "from 0 to below 1");
        }
        if !(1..=MAX_BASELINE).contains(&self.filter_baseline) {
            return bad("filter_baseline", self.filter_baseline.to_string(), &format!("1 to {MAX_BASELINE}"));
        }
        if self.filter_history > MAX_HISTORY {
            return bad("filter_history", self.filter_history.to_string(), &format!("at most {MAX_HISTORY}"));
        }
        for (knob, value) in [
            ("iterations", self.iterations),
            ("batch_size", self.batch_size),
            ("downscale", self.downscale),
            ("max_cap", self.max_cap),
        ] {
            if value == 0 {
                return bad(knob, "0".into(), "at least 1");
            }
        }
        for (knob, value, high) in [
            ("control_nodes", self.control_nodes, splat4d::motion::skin::MAX_NODES),
            ("control_neighbours", self.control_neighbours, splat4d::motion::skin::MAX_NEIGHBOURS),
            ("control_bind_interval", self.control_bind_interval, usize::MAX),
        ] {
            if !(1..=high).contains(&value) {
                return bad(knob, value.to_string(), &format!("1 to {high}"));
            }
        }
        if self.sh_degree > 3 {
            return bad("sh_degree", self.sh_degree.to_string(), "0, 1, 2 or 3");
        }
        if self.sh_harmonics > MAX_HARMONICS {
            return bad("sh_harmonics", self.sh_harmonics.to_string(), "0, 1 or 2");
        }
        if self.motion_order > 3 {
            return bad("motion_order", self.motion_order.to_string(), "0, 1, 2 or 3");
        }
        for (knob, value, known) in [
            ("motion", &self.motion, &known_motions()[..]),
            ("life", &self.life, &["auto", "infinite", "gauss-half", "gauss-one", "interval"][..]),
            ("crowding", &self.crowding, &["none", "merge", "prune"][..]),
            ("prune_score", &self.prune_score, &PRUNE_SCORES[..]),
            ("control_trajectory", &self.control_trajectory, &TRAJECTORIES[..]),
            ("strategy", &self.strategy, &["mcmc", "adc", "none"][..]),
            ("deform_trunk", &self.deform_trunk, &["auto", "mlp", "small", "hash", "hash-linear"][..]),
            ("filter", &self.filter, &Fusion::ALL.map(|(name, _)| name)[..]),
            ("filter_predictor", &self.filter_predictor, &Predictor::ALL.map(|(name, _)| name)[..]),
            ("features", &self.features, &["none", FULL][..]),
            ("transport", &self.transport, &["off", "linear", "wasserstein"][..]),
            ("ssm_mode", &self.ssm_mode, &["bidirectional", "causal"][..]),
            ("ssm_output", &self.ssm_output, &["absolute", "twist"][..]),
            ("ssm_equivariance", &self.ssm_equivariance, &["none", "frames", "vector"][..]),
        ] {
            if !known.contains(&value.as_str()) {
                let near = nearest(value, known).map(|n| format!("; did you mean `{n}`?")).unwrap_or_default();
                return bad(knob, format!("`{value}`"), &format!("one of {}{near}", known.join(", ")));
            }
        }
        Ok(())
    }

    /// Fills every iteration knob that is 0 from `iterations`, so that the saved recipe says all.
    #[must_use]
    pub fn resolve(&self) -> Self {
        let mut r = self.clone();
        let fill = |knob: &mut usize, value: usize| {
            if *knob == 0 {
                *knob = value.max(1);
            }
        };
        if r.features == FULL {
            r.sh_degree = 0;
        }
        if r.min_opacity == 0.0 {
            r.min_opacity = if r.strategy == "mcmc" { MCMC_DEAD_OPACITY } else { ADC_DEAD_OPACITY };
        }
        fill(&mut r.sh_degree_interval, r.iterations / 10);
        fill(&mut r.densification_interval, (r.iterations / 60).max(50));
        fill(&mut r.densify_from_iter, r.iterations / 20);
        fill(&mut r.densify_until_iter, r.iterations * 3 / 4);
        fill(&mut r.relocate_from_iter, r.iterations / 15);
        fill(&mut r.checkpoint_interval, (r.iterations / 10).max(50));
        r
    }
}

/// What `motion` may be: the models that train by themselves, and the choice among them.
fn known_motions() -> Vec<&'static str> {
    std::iter::once("auto").chain(splat4d::motion::MODELS.iter().copied()).collect()
}

/// The known name closest to `name` (Damerau-free Levenshtein), if it is close enough to be meant.
pub fn nearest<'a>(name: &str, known: &[&'a str]) -> Option<&'a str> {
    let distance = |a: &str, b: &str| {
        let b: Vec<char> = b.chars().collect();
        let mut row: Vec<usize> = (0..=b.len()).collect();
        for (i, ca) in a.chars().enumerate() {
            let mut diagonal = row[0];
            row[0] = i + 1;
            for (j, cb) in b.iter().enumerate() {
                let next = (diagonal + usize::from(ca != *cb)).min(row[j] + 1).min(row[j + 1] + 1);
                diagonal = std::mem::replace(&mut row[j + 1], next);
            }
        }
        row[b.len()]
    };
    let best = known.iter().map(|k| (distance(&name.to_lowercase(), k), *k)).min()?;
    (best.0 <= 2.max(name.len() / 3)).then_some(best.1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn toml_round_trip_and_set() {
        let mut r = Recipe::default();
        r.set("iterations=300").unwrap();
        r.set("motion = still").unwrap();
        r.set("position_lr_init=1").unwrap();
        r.set("max_cap=2e4").unwrap();
        assert_eq!((r.iterations, r.motion.as_str(), r.max_cap), (300, "still", 20_000));
        assert_eq!(Recipe::from_toml(&r.to_toml()).unwrap(), r);
    }

    #[test]
    fn unknown_knobs_get_a_suggestion_and_wrong_values_a_reason() {
        let mut r = Recipe::default();
        let error = |r: &mut Recipe, s: &str| r.set(s).unwrap_err().to_string();
        assert!(error(&mut r, "iteration=3").contains("`iterations`"));
        assert!(error(&mut r, "iterations=many").contains("integer"));
        assert!(error(&mut r, "motion=spacetme").contains("`spacetime`"));
        assert!(error(&mut r, "iterations").contains("key=value"));
        assert!(error(&mut r, "opacity_lr=nan").contains("positive"));
        assert!(Recipe::from_toml("densify_untl_iter = 3").unwrap_err().to_string().contains("densify_until_iter"));
        assert!(Recipe::from_toml("= 3").is_err());
        assert_eq!(r, Recipe::default(), "a refused setting changes nothing");
    }

    #[test]
    fn resolve_leaves_nothing_open_and_every_knob_is_documented() {
        let r = Recipe { iterations: 1000, ..Recipe::default() }.resolve();
        assert_eq!((r.densify_from_iter, r.densify_until_iter, r.checkpoint_interval), (50, 750, 100));
        assert_eq!(r.resolve(), r);
        assert!(Recipe::knobs().iter().all(|k| k.doc.len() > 8), "{:?}", Recipe::knobs());
    }
}
