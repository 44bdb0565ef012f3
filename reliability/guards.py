"""Does a test fail when the guard that it tests is taken away?

    python reliability/guards.py [--only WORD]

Each row is one kind of fault, the guard in the source against it, and the test that must notice its
absence. The guard is removed in a copy of the package and the test is run there.
"""

import argparse
import sys
from typing import NamedTuple

from sandbox import changed, run, sandbox


class Guard(NamedTuple):
    kind: str
    file: str
    changes: tuple[tuple[str, str], ...]  # what stands there, and what is put in its place
    test: str


STORE, FIT, HEALTH = "marlyap/storage/store.py", "marlyap/runs/fit.py", "marlyap/learning/health.py"
HASH = ('if _sha256([data]) != facts["sha256"]:', "if False:")
GUARDS = [
    Guard(
        "1 kill -9 in a save",
        STORE,
        (("            os.rename(directory, old)\n", "            shutil.rmtree(directory)\n"),),
        "tests/test_store.py::test_a_crash_before_any_system_call_leaves_all_loadable",
    ),
    Guard(
        "2 SIGTERM",
        "marlyap/runs/stop.py",
        (("for s in (signal.SIGINT, signal.SIGTERM)}", "for s in (signal.SIGINT,)}"),),
        "tests/test_resume.py::test_what_is_stopped_says_how_to_go_on",
    ),
    Guard(
        "3 SIGINT",
        "marlyap/runs/stop.py",
        (("return self.signal != 0", "return False"),),
        "tests/test_resume.py::test_what_is_stopped_says_how_to_go_on",
    ),
    Guard(
        "4 full disk",
        STORE,
        (("            _erase(scratch)\n            raise\n", "            raise\n"),),
        "tests/test_store.py::test_a_full_disk_costs_nothing_that_was_there",
    ),
    Guard(
        "5 read-only directory",
        STORE,
        (("(errno.EACCES, errno.EPERM, errno.EROFS)", "()"),),
        "tests/test_store.py::test_a_directory_one_may_not_write_in",
    ),
    Guard(
        "6 truncation",
        STORE,
        (HASH, ('if len(data) < facts["bytes"]:', "if False:"), ("or len(body) != end", "")),
        "tests/test_store.py::test_truncation_at_any_place_is_detected",
    ),
    Guard(
        "7 bit flip",
        STORE,
        (HASH,),
        "tests/test_store.py::test_a_flipped_bit_at_any_place_is_detected",
    ),
    Guard(
        "8 zeroed block",
        STORE,
        (HASH,),
        "tests/test_store.py::test_a_zeroed_block_is_detected_and_the_array_named",
    ),
    Guard(
        "9 missing file",
        STORE,
        (("in sorted({PAYLOAD, MANIFEST} ^ {*os.listdir(handle)})", "in ()"),),
        "tests/test_store.py::test_a_missing_file_is_named",
    ),
    Guard(
        "10 edited manifest",
        STORE,
        (('raw != sealed({key: found[key] for key in found if key != "sha256"})', "False"),),
        "tests/test_store.py::test_an_edited_manifest_is_detected",
    ),
    Guard(
        "11 future schema",
        STORE,
        (
            ("if type(schema) is int and schema > SCHEMA:", "if False:"),
            ("if schema != SCHEMA or", "if"),
        ),
        "tests/test_store.py::test_a_future_schema_asks_for_an_upgrade",
    ),
    Guard(
        "12 other config",
        "marlyap/runs/run.py",
        (("    store.expect(arrays, dict(zip(names, bits, strict=True)), source)\n", ""),),
        "tests/test_resume.py::test_a_checkpoint_of_another_config_is_refused",
    ),
    Guard(
        "13 other dtype or shape",
        STORE,
        (("        if found != wanted:\n", "        if False:\n"),),
        "tests/test_store.py::test_expect_names_the_first_array_that_differs",
    ),
    Guard(
        "14 pickle in disguise",
        STORE,
        (("if head.tobytes() != header or len(body) != end:", "if False:"),),
        "tests/test_store.py::test_a_pickle_in_disguise_is_refused_unopened",
    ),
    Guard(
        "15 path traversal",
        STORE,
        (("or [*files] != [PAYLOAD]", ""),),
        "tests/test_store.py::test_no_path_leads_out_of_the_directory",
    ),
    Guard(
        "15 symbolic link",
        STORE,
        (("(os.O_NOFOLLOW if within else 0)", "0"),),
        "tests/test_store.py::test_links_pipes_and_directories_are_not_files",
    ),
    Guard(
        "16 header bomb",
        STORE,
        (("if head.tobytes() != header or len(body) != end:", "if False:"),),
        "tests/test_store.py::test_a_bad_header_is_refused",
    ),
    Guard(
        "16 huge manifest",
        STORE,
        ((" or status.st_size > limit:", ":"),),
        "tests/test_store.py::test_a_huge_manifest_is_refused_unread",
    ),
    Guard(
        "17 two writers",
        STORE,
        (("fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)", "pass"),),
        "tests/test_store.py::test_two_writers_the_second_is_told_who_is_first",
    ),
    Guard(
        "18 stale scratch",
        STORE,
        (("            _erase(directory / scratch[0])\n", "            pass\n"),),
        "tests/test_store.py::test_what_the_dead_left_goes_and_what_the_living_hold_stays",
    ),
    Guard(
        "19 newest corrupt",
        STORE,
        (
            (
                "            except CorruptError as fault:\n                warnings.append(",
                "            except ZeroDivisionError as fault:\n                warnings.append(",
            ),
        ),
        "tests/test_store.py::test_a_bad_newest_falls_back_with_a_warning",
    ),
    Guard(
        "20 not finite: found and named",
        HEALTH,
        (('for name in ("obs", "features", "reward", "cost", "negative"):', "for name in ():"),),
        "tests/test_resume.py::test_the_agent_and_the_step_of_a_bad_reward_are_named",
    ),
    Guard(
        "20 not finite: the array, agent and update",
        FIT,
        (("run.trainer.diagnose(run.load()[0], done)", "None"),),
        "tests/test_resume.py::test_the_array_the_agent_and_the_update_are_named",
    ),
    Guard(
        "20 not finite: never saved",
        FIT,
        (
            (
                "told.health_of(i), trainer.agents)\n            if fault and",
                "told.health_of(i), trainer.agents) and None\n            if fault and",
            ),
        ),
        "tests/test_resume.py::test_when_all_diverge_training_stops_and_the_checkpoints_stay",
    ),
    Guard(
        "20 not finite: rolled back",
        FIT,
        (("key = jax.random.fold_in(self.carry.key, attempt)", "key = self.carry.key"),),
        "tests/test_resume.py::test_a_run_rolls_back_and_tries_other_random_numbers",
    ),
    Guard(
        "21 one diverged seed of several (vmap)",
        FIT,
        (("                if not any(alive):\n", "                if True:\n"),),
        "tests/test_resume.py::test_a_diverged_seed_does_not_touch_its_neighbour",
    ),
    Guard(
        "21 one diverged seed of several (processes)",
        "marlyap/runs/launch.py",
        (("                    failed.append(said", "                    raise UserError(said"),),
        "tests/test_resume.py::test_a_process_that_fails_leaves_the_other_seeds_alone",
    ),
    Guard(
        "22 task of the wrong shape",
        "marlyap/conformance/laws.py",
        (("    if not fits or jnp", "    if jnp"),),
        "tests/test_check_task.py::test_a_broken_task_is_caught_and_its_fault_named[OneCostForAll]",
    ),
    Guard(
        "22 task that is not finite",
        "marlyap/conformance/laws.py",
        (("            if bad.any():\n", "            if False:\n"),),
        "tests/test_check_task.py::test_a_broken_task_is_caught_and_its_fault_named[RewardIsALogarithm]",
    ),
    Guard(
        "23 action out of range",
        "marlyap/games/dynamics.py",
        (("jnp.clip(action, -1.0, 1.0) *", "action *"),),
        "tests/test_dynamics.py::test_actions_are_clipped_and_scaled_by_the_limits",
    ),
    Guard(
        "24 config out of range",
        "marlyap/games/game.py",
        (("        if not 0 < self.dt <= 10:\n", "        if False:\n"),),
        "tests/test_every_task.py::test_bad_fields_are_named",
    ),
    Guard(
        "24 typo",
        "marlyap/runs/config.py",
        (("        return f\"did you mean '{near[0]}'?\"\n", "        pass\n"),),
        "tests/test_config.py::test_unknown_names_are_refused_with_a_suggestion",
    ),
]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="rows whose kind has this word in it")
    args = parser.parse_args()
    missed, chosen = [], [g for g in GUARDS if args.only in g.kind]
    with sandbox() as place:
        for guard in chosen:
            text = (place / guard.file).read_text()
            for old, new in guard.changes:
                if text.count(old) != 1:
                    raise SystemExit(f"{guard.kind}: {old!r} is not once in {guard.file}")
                text = text.replace(old, new)
            with changed(place, {guard.file: text}):
                verdict, seconds, said = run(place, [guard.test])
            noticed = verdict in ("failed", "time")
            print(
                f"{'noticed' if noticed else 'MISSED':8} {guard.kind:45} {seconds:5.1f} s",
                flush=True,
            )
            if not noticed:
                missed.append(guard.kind)
                print(said, flush=True)
    print(f"{len(chosen) - len(missed)} of {len(chosen)} removed guards were noticed.")
    return int(bool(missed))


if __name__ == "__main__":
    sys.exit(main())
