#!/bin/bash
# Submit with: sbatch FILE; when the array is done: vsfsim {{ command }}
# The same file may be submitted again at any time: it makes what is missing.
#SBATCH --job-name=vsfsim
#SBATCH --array=0-{{ shards - 1 }}
#SBATCH --ntasks=1
#SBATCH --cpus-per-task=2
#SBATCH --mem-per-cpu=4G
#SBATCH --time=240
#SBATCH --signal=TERM@30
#SBATCH --requeue
{% if gpus %}
#SBATCH --gpus-per-task={{ gpus }}
{% else %}
# no GPU
{% endif %}
#SBATCH --output=slurm-%A_%a.log
srun vsfsim cluster --shard auto {{ command }} --workers "$SLURM_CPUS_PER_TASK"
