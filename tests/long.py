"""Tests that the quick run leaves out: each takes more than four seconds on a fresh cache.

They run with `./run test -m ''`. Of each kind a shorter or more telling one stays in the quick run.
"""

LONG: dict[str, tuple[str, ...]] = {
    "test_apg.py": ("test_a_small_team_is_solved[0.0]",),
    "test_bench.py": (
        "test_a_controller_is_local_bounded_and_finite[voltage13-dead-band]",
        "test_every_command_takes_it[microgrid]",
        "test_humans_on_a_ring_break_up_and_one_car_that_holds_its_speed_calms_them[220-0.0236]",
        "test_without_control_it_diverges[cartpoles-1.082-0.003]",
        "test_without_control_it_diverges[frequency-weak-1.0011-5e-05]",
    ),
    "test_benchmarks.py": (
        "test_quick[checkpoint]",
        "test_quick[update]",
    ),
    "test_certificates.py": (
        "test_a_ball_is_taken_that_the_controller_keeps",
        "test_a_perturbation_changes_what_it_says",
        "test_a_stable_linear_game_is_accepted",
        "test_pathological_controllers_are_refused[controller0]",
        "test_the_linearisation_says_no_to_the_unicycle",
        "test_what_needs_v_is_left_out_by_name_and_the_others_run",
    ),
    "test_certify.py": (
        "test_bad_input_is_one_sentence_and_changes_nothing[few]",
        "test_nothing_is_silently_absent",
    ),
    "test_check_task.py": (
        "test_a_broken_task_is_caught_and_its_fault_named[StepHasItsOwnChance]",
        "test_costs_may_jump_where_the_game_says_so",
    ),
    "test_cli.py": (
        "test_nan_from_a_users_task_is_named_and_the_last_checkpoint_is_intact",
        "test_nan_in_what_a_task_observes_is_named_in_the_warm_up",
        "test_report_prints_one_object",
    ),
    "test_config.py": (
        "test_a_run_that_others_edited_opens_or_is_refused",
        "test_build_raises_nothing_but_user_errors",
        "test_describe_names_every_field_that_can_be_set",
    ),
    "test_devices.py": ("test_four_devices_do_what_one_does",),
    "test_docs.py": (
        "test_code_blocks_run[add-a-constraint.md]",
        "test_code_blocks_run[add-a-source.md]",
        "test_code_blocks_run[add-a-task.md]",
        "test_code_blocks_run[add-an-algorithm.md]",
    ),
    "test_entries.py": (
        "test_an_observation_can_be_built_from_its_entries[False-unicycle]",
        "test_every_entry_of_every_task_has_a_name_and_a_unit[gnn-flock]",
    ),
    "test_every_task.py": (
        "test_the_laws_of_the_library_are_kept[TASKS[platoon-catchup]]",
        "test_the_laws_of_the_library_are_kept[TASKS[voltage13]]",
        "test_the_laws_of_the_library_are_kept[complete]",
        "test_the_laws_of_the_library_are_kept[disk]",
    ),
    "test_examples.py": (
        "test_compare",
        "test_evaluate_and_draw",
        "test_own_task",
    ),
    "test_golden.py": (
        "test_in_double_precision_to_a_billionth[ring2]",
        "test_in_double_precision_to_a_billionth[ring]",
        "test_in_single_precision_to_a_ten_thousandth[ring2]",
        "test_in_single_precision_to_a_ten_thousandth[ring]",
    ),
    "test_liars.py": (
        "test_no_liar_is_believed_and_every_honest_one_is[V]",
        "test_no_liar_is_believed_and_every_honest_one_is[check-task]",
        "test_no_liar_is_believed_and_every_honest_one_is[closed-form]",
        "test_no_liar_is_believed_and_every_honest_one_is[composition]",
        "test_no_liar_is_believed_and_every_honest_one_is[contraction]",
        "test_no_liar_is_believed_and_every_honest_one_is[information]",
        "test_no_liar_is_believed_and_every_honest_one_is[recheck]",
        "test_no_liar_is_believed_and_every_honest_one_is[robustness]",
        "test_no_liar_is_believed_and_every_honest_one_is[safe]",
    ),
    "test_many_agents.py": ("test_a_policy_of_several_kinds_trains",),
    "test_measure.py": (
        "test_a_full_disk_costs_no_picture_that_was_there",
        "test_a_report_of_several_runs_is_beside_none_of_them",
        "test_a_report_says_what_is_wrong_with_a_log[-missing, empty or cut off]",
        "test_report_and_watch_show_the_game_that_was_asked",
    ),
    "test_on_policy.py": (
        "test_episodes_may_be_handed_in[off-policy]",
        "test_episodes_may_be_handed_in[on-policy]",
        "test_the_algorithm_of_the_page_learns",
    ),
    "test_options.py": (
        "test_an_option_disturbs_the_motion_and_not_the_target[frequency-droop-load_step-0.5]",
    ),
    "test_python.py": (
        "test_a_wrong_type_is_one_sentence",
        "test_what_was_trained_is_saved_as_a_run",
    ),
    "test_recheck.py": (
        "test_its_world_is_the_same[dynamics0-norm-change0]",
        "test_true_restatements_are_accepted",
        "test_what_a_linearisation_does_not_show_cannot_be_claimed[dynamics0]",
        "test_what_a_linearisation_does_not_show_cannot_be_claimed[dynamics1]",
    ),
    "test_references.py": ("test_decentralised_agents_learn_nothing_from_each_other",),
    "test_report.py": ("test_long_film_keeps_the_gif_short",),
    "test_resume.py": (
        "test_a_diverged_seed_does_not_touch_its_neighbour",
        "test_a_stopped_run_ends_bit_for_bit_like_an_uninterrupted_one"
        "[after each iteration-masac-lyapunov-vmapped pair]",
        "test_a_stopped_run_ends_bit_for_bit_like_an_uninterrupted_one"
        "[in mid run-masac-lyapunov-vmapped pair]",
        "test_each_algorithm_and_each_reading_resumes_bit_for_bit[matd3]",
        "test_seeds_differ_and_vmapping_changes_no_record",
        "test_the_array_the_agent_and_the_update_are_named",
    ),
    "test_strangers.py": (
        "test_a_task_of_the_page_keeps_all_laws[moving_formation]",
        "test_a_task_of_the_page_keeps_all_laws[platoon]",
        "test_a_task_of_the_page_keeps_all_laws[swap]",
    ),
    "test_toy_games.py": (
        "test_every_algorithm_finds_the_answers[masac-lyapunov]",
        "test_every_algorithm_finds_the_answers[matd3]",
    ),
    "test_traced.py": ("test_another_rate_traces_nothing_and_is_not_the_same_training[apg]",),
    "test_wrong_inputs.py": (
        "test_a_wrong_input_is_answered_in_one_sentence[report RUN --out missing/deep/r.html]",
    ),
}
