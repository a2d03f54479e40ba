"""What nerfstudio 1.1.5 needs on present-day libraries and on machines without a network.

A model asks for what it needs when it is built; on import nothing here acts. All that this package
changes for a whole process, beside random seeds of `leco shrink`, `leco capacity` and `leco check`:

| what is changed | by | why | until |
|---|---|---|---|
| `sys.excepthook`, in nerfstudio's commands | `commands`, for `method_configs` | nerfstudio shows a
  traceback for what a user can mend | the process ends |
| a filter of warnings, in `ns-train` of a method of ours | `commands`, for `scenes.city_dataparser`
  | torch has renamed what nerfstudio decorates its activations with | the process ends |
| `check_ffmpeg_installed` of nerfstudio, in `ns-render` | `commands`, for `method_configs` | images
  need no ffmpeg | the process ends |
| the file of nerfstudio's console and of rich's, filters of warnings | `run_progress`, for
  `trainer` and `processes` | what nobody acts on goes to a run's log file | a run is set up,
  trained, or over |
| `torch.serialization.add_safe_globals` | `checkpoints` | torch 2.6 refuses the numpy scalars in
  nerfstudio's checkpoints | the process ends: nerfstudio may load again at any time |
| `eval_load_checkpoint` of nerfstudio | `checkpoints` | damaged checkpoints, moved runs | the
  process ends: a pipeline may load again |
| `launch` and `_distributed_worker` of nerfstudio's launcher | `processes` | it wants CUDA, and
  ends in a traceback when a process is lost | the launch is over |
| `DDP` and `dist` of nerfstudio's pipelines, `comms.LOCAL_PROCESS_GROUP`, torch's threads |
  `processes` | data-parallel runs on a CPU | the process ends, which was started for one run |
| the handler of SIGINT | `trainer` | Ctrl-C stops after a step | training is over |
| the level and a handler of the logger `leco_plugin` | `log`, for `trainer` | a run says what its
  samplers log | the process ends: a second run says it too |
| a function at exit | `run_folder` | lets go of a run's folder | it has run |
| `_NoTrainLpips` of torchmetrics | `host_models` | no network is asked for weights | the host is
  built |
| functions of nerfacc, wherever they are imported | `samplers.nerfacc_cpu` | its own need CUDA
  | `nerfacc_cpu.uninstall()`, which nothing here calls: models go on using them |
| `mallopt` of glibc, for models on a CPU | `models.compute.device` | page faults at each step | the
  process ends: the blocks are those of all steps |
| what `sys.stdout` writes for letters that it cannot, in `leco` | `cli` | the name of a photograph
  need not be UTF-8 | the process ends |
| filters of warnings, in `leco` | `cli` | nerfstudio's and torch's are of no use to a user |
  `main` returns |
| methods of field classes | `evaluation.queries` | counts queries | the count is over |
| torch's threads, `GLOO_SOCKET_IFNAME` | `conformance.samplers` | two ranks on one machine | the
  process ends, which was started for one rule |

Instances are changed too, each for as long as it lasts: a model's hash encodings are replaced by
fast ones (`hash_encoding`), and a data manager's reader is a checked one (`scenes.reading`).

Names that nerfstudio 1.1.5 keeps to itself are read in this folder alone.
Methods with such names that its own subclasses override, as `_generate_dataparser_outputs` of a
reader or `_get_pixel_sampler` of a data manager, are overridden where the subclass is.
"""
