#!/usr/bin/env bash
# What a GPU shows, within ten minutes on a machine with one NVIDIA GPU: make gpu.
#
#   experiments/benchmarks/gpu.sh                        # everything, the most telling first
#   experiments/benchmarks/gpu.sh seeds bench            # some of: device scaling seeds agreement warp warp_agreement bench warp_bench
#   SMALL=1 experiments/benchmarks/gpu.sh                # the same with tiny sizes, to see that it works, on a CPU too
#
# PYTHON (.venv/bin/python, else python3), OUT (runs/gpu) and LIMIT (570 seconds in all) can be set. Each part has a time
# limit and a log of its own; one that fails or takes too long leaves the others alone. Those of engine=warp are skipped
# where warp-lang is not installed. Points that $OUT/scaling.csv
# already has are skipped, so what LIMIT cut off can follow in a second call. The end says what came out; the exit code is
# the number of parts that failed.
set -uo pipefail
cd "$(dirname "$0")/../.."
if [ -z "${PYTHON:-}" ]; then
  PYTHON=python3
  [ -x .venv/bin/python ] && PYTHON=.venv/bin/python
fi
OUT=${OUT:-runs/gpu}
LIMIT=${LIMIT:-570}
mkdir -p "$OUT"
export PYTHONUNBUFFERED=1
# Compiled programs stay with the results: a part that is run again does not wait for them.
export JAX_COMPILATION_CACHE_DIR=${JAX_COMPILATION_CACHE_DIR:-/tmp/rcg_jax_gpu_cache}

if [ -n "${SMALL:-}" ]; then
  envs=20,40 seeds_envs=20 seeds=1,2 length=100 raw_envs=20 raw_batch=2000
  rounds=1 warmup=1 point_s=900 task=point_maze agreement="num_envs=10 length=20 task=point_maze timeout=900"
else
  envs=1024,4096,16384 seeds_envs=250 seeds=1,5 length=200
  raw_envs=4096 raw_batch=819200 rounds=5 warmup=2 point_s=240 task=ring_peg agreement="num_envs=100 length=200"
fi

began=$SECONDS
failed=0
summary=$OUT/summary.txt
: >"$summary"

# part NAME SECONDS COMMAND...: runs it if it was asked for and time is left.
part() {
  local name=$1 most=$2 left code start=$SECONDS
  shift 2
  case " $wanted " in *" $name "*) ;; *) return ;; esac
  left=$((LIMIT - (SECONDS - began)))
  if [ "$left" -lt 20 ]; then
    echo "$name: no time left; experiments/benchmarks/gpu.sh $name does it" | tee -a "$summary"
    failed=$((failed + 1))
    return
  fi
  [ -n "${SMALL:-}" ] || [ "$most" -gt "$left" ] && most=$left # a CPU compiles for as long as it takes
  if [[ $name == warp* ]] && ! "$PYTHON" -c 'import warp' 2>/dev/null; then
    echo "$name: skipped, warp-lang is not installed (pip install '.[warp]')" | tee -a "$summary"
    return
  fi
  echo "== $name: $*"
  # INT lets a sweep end its own processes.
  timeout --signal=INT --kill-after=10 "$most" "$@" 2>&1 | tee "$OUT/$name.log"
  code=${PIPESTATUS[0]}
  case $code in
    0) echo "$name: done in $((SECONDS - start)) s" ;;
    124 | 130 | 137) echo "$name: stopped after $((SECONDS - start)) s" ;;
    *) echo "$name: exit code $code after $((SECONDS - start)) s: $(tail -n 1 "$OUT/$name.log")" ;;
  esac | tee -a "$summary"
  [ "$code" = 0 ] || failed=$((failed + 1))
}

parts="device scaling seeds agreement warp warp_agreement bench warp_bench"
wanted=${*:-$parts}
for name in $wanted; do
  case " $parts " in
    *" $name "*) ;;
    *) echo "error: $name: must be some of $parts" >&2; exit 2 ;;
  esac
done

points=("length=$length" "rounds=$rounds" "warmup=$warmup" seconds=20 "tasks=$task" "out=$OUT/scaling.csv")
mjx_points=(engines=mjx "timeout=$point_s" "${points[@]}")
# The first point waits for NVIDIA's compiler; its kernels stay in ~/.cache/warp.
warp_points=(engines=warp "timeout=$((point_s + 160))" "${points[@]}")
bench=(strict=0 startup=0 warmup=2 rounds=3 "task=$task" "num_envs=$raw_envs" "batch_size=$raw_batch")
part device 60 bash -c "nvidia-smi 2>/dev/null || echo 'no nvidia-smi'; '$PYTHON' -c 'import jax; print(jax.__version__, jax.devices())'"
part scaling 420 "$PYTHON" -m experiments.benchmarks.scaling "${mjx_points[@]}" "num_envs=$envs"
# The paper's batch, 50,000 steps: one seed, and five in one program.
part seeds 300 "$PYTHON" -m experiments.benchmarks.scaling "${mjx_points[@]}" "num_envs=$seeds_envs" "num_seeds=$seeds"
# shellcheck disable=SC2086
part agreement 300 "$PYTHON" -m experiments.benchmarks.gpu_agreement $agreement "out=$OUT/gpu_agreement.csv"
part warp 420 "$PYTHON" -m experiments.benchmarks.scaling "${warp_points[@]}" "num_envs=$envs"
# shellcheck disable=SC2086
part warp_agreement 300 "$PYTHON" -m experiments.benchmarks.gpu_agreement engine=warp $agreement "out=$OUT/warp_agreement.csv"
part bench 400 "$PYTHON" -m experiments.benchmarks.bench engines=mjx "${bench[@]}" "out=$OUT/bench.csv"
part warp_bench 400 "$PYTHON" -m experiments.benchmarks.bench engines=warp "${bench[@]}" "out=$OUT/warp_bench.csv"

echo "== summary, $((SECONDS - began)) s"
cat "$summary"
[ -f "$OUT/scaling.csv" ] && "$PYTHON" - "$OUT/scaling.csv" <<'END'
import csv, sys

rows = list(csv.DictReader(open(sys.argv[1])))
for row in rows:
    size = f"{row['task']} {row['engine']} {int(row['num_envs']):6,} envs x {row['num_seeds']} seeds"
    if row["status"] != "ok":
        print(f"{size}: {row['status']} ({row['note']})")
        continue
    speed = float(row["steps_per_s"])
    print(
        f"{size}: {speed:11,.0f} env-steps/s, compiled in {row['compile_s']} s, "
        f"{row['device_gb'] or row['run_gb']} GiB; 100 M steps of a seed in {1e8 / speed * int(row['num_seeds']) / 60:.1f} min"
    )


def kind(row):
    return row["task"], row["engine"], row["num_envs"]


one = {kind(row): float(row["iteration_s"]) for row in rows if row["num_seeds"] == "1" and row["status"] == "ok"}
for row in rows:
    if row["num_seeds"] != "1" and row["status"] == "ok" and kind(row) in one:
        ratio = float(row["iteration_s"]) / one[kind(row)]
        print(f"{row['num_seeds']} vmapped seeds take {ratio:.2f} x the time of one, at {row['num_envs']} envs each")
END
exit "$failed"
