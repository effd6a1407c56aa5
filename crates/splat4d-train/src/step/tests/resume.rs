//! A run of several stages, models with state of their own and losses with a memory continue from a checkpoint at any
//! step as if they had not been interrupted: the same bytes, with another number of threads.

use super::bed::{Bed, bytes, saved, settings};

/// Trains once; then again from checkpoints around every change of stage, and in the middle of every stage.
fn check(lines: &[&str]) {
    let bed = Bed::new();
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    for line in lines {
        let recipe = settings(line);
        let mut trainer = bed.start(&recipe);
        let lengths: Vec<usize> = trainer.stages.iter().map(|s| s.iterations).collect();
        let mut kept = Vec::new();
        while !trainer.is_done() {
            let p = trainer.progress;
            let length = lengths[p.stage];
            let around = [0, 1, length / 2, length - 1].contains(&p.stage_step);
            // Where the run was planned again, places are passed over, and stayed at.
            let anywhere = !recipe.run.replans.rows().is_empty() && p.iteration.is_multiple_of(3);
            if p.iteration > 0 && (around || anywhere) {
                kept.push((p.iteration, saved(&trainer)));
            }
            trainer.step().unwrap().unwrap_or_else(|fault| panic!("{line}: {}", fault.0));
        }
        assert_eq!(trainer.progress.iteration, trainer.iterations(), "{line}");
        let whole = bytes(trainer.scene());
        // Every other one: an error would show at more than one step.
        for (iteration, checkpoint) in kept.iter().step_by(2) {
            let again = pool.install(|| {
                let mut trainer = bed.resumed(&recipe, checkpoint);
                assert_eq!(trainer.progress.iteration, *iteration);
                assert!(saved(&trainer) == *checkpoint, "{line}: reading a checkpoint changes it, at step {iteration}");
                while !trainer.is_done() {
                    trainer.step().unwrap().unwrap_or_else(|fault| panic!("{line}: {}", fault.0));
                }
                bytes(trainer.scene())
            });
            assert!(again == whole, "{line}: resumed after step {iteration}, it ends elsewhere");
        }
    }
}

#[test]
fn networks() {
    check(&[
        "motion=hexplane coarse_iterations=10 unlock_interval=10 plane_channels=16 plane_resolution=6 net_width=16",
        "motion=deform-mlp deform_warmup=0.3 deform_width=16 deform_time_noise=0.5 lambda_iso=1",
        "motion=deform-mlp deform_warmup=0.2 deform_width=16 deform_trunk=hash-linear sh_degree_interval=5",
        "motion=native4d sh_harmonics=1 strategy=mcmc",
    ]);
}

#[test]
fn nodes() {
    check(&[
        "motion=control control_nodes=12 control_adapt_interval=6 control_grad_threshold=1e-6 control_mask=true \
         lambda_node_arap=1 lambda_node_elastic=1e-3 lambda_node_acceleration=1e-3 control_bind_interval=7",
        "motion=control control_nodes=8 control_trajectory=low-rank lambda_sparse=0.1 lambda_arap=1",
        "motion=ssm control_nodes=12 ssm_width=8 ssm_states=4 ssm_warm_up=0.3 control_adapt_interval=6 \
         control_grad_threshold=1e-6 ssm_equivariance=vector",
        "motion=ssm control_nodes=8 ssm_width=8 ssm_states=4 ssm_equivariance=frames ssm_mode=causal ssm_output=twist",
    ]);
}

#[test]
fn filters_and_frames() {
    check(&[
        "motion=tracked rigid_neighbours=5 track_feature_lr=1e-3 filter=geodesic filter_start=0.1",
        "motion=tracked rigid_neighbours=5 filter=geodesic filter_start=0.1 filter_keep=true",
        "motion=hexplane coarse_iterations=10 plane_channels=16 plane_resolution=6 net_width=16 filter=literal \
         filter_history=1 filter_start=0.4 transport=linear filter_keep=true",
        "motion=control control_nodes=8 filter=geodesic filter_start=0.1 transport=wasserstein",
    ]);
}

/// Three steps of the schedule at a time, then many at each of its steps: hooks, switches and splits come once.
#[test]
fn replanned_runs() {
    check(&[
        "motion=spacetime run.replans=[[8,18],[14,60]] static_split=0.02 static_split_from=0.7 strategy=mcmc",
        "motion=tracked run.replans=[[8,18],[14,60]] rigid_neighbours=5 filter=geodesic filter_start=0.1",
        "motion=hexplane run.replans=[[8,18],[14,60]] coarse_iterations=10 unlock_interval=10 plane_channels=16 \
         plane_resolution=6 net_width=16 filter=geodesic filter_start=0.5",
        "motion=deform-mlp run.replans=[[8,18],[14,60]] deform_warmup=0.3 deform_width=16 deform_time_noise=0.5",
    ]);
}

#[test]
fn splits_and_crowds() {
    check(&[
        "static_split=0.02 motion=spacetime lambda_velocity=0.1 lambda_rigid=1 static_split_from=0.5",
        "static_split=0.02 motion=tracked rigid_neighbours=5 static_split_from=0.5 track_feature_lr=1e-3",
        "static_split=0.02 motion=hexplane coarse_iterations=10 plane_channels=16 plane_resolution=6 net_width=16 \
         filter=geodesic filter_start=0.2 static_split_from=0.5 lambda_jerk=1",
        "crowding=merge crowding_interval=5 crowding_distance=3 motion=control control_nodes=8 lambda_rigid=1 \
         relocate_interval=6 relocate_from_iter=5 relocate_opacity=0.2 relocate_share=0.1 prune_interval=14",
    ]);
}
