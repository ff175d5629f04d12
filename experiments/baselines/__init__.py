"""This system and what it is compared with: one small file per method, all on `render` and `fit`, one scorer for all.

None of them is the published program. Each keeps the idea that its source is known for and runs at the same size,
from the same initial scene where its source has one, with the budget of steps that the preset gives. What each keeps
and what it leaves out stands at the top of its file.

| method | file | after |
|---|---|---|
| ltgs | system.py | this project |
| untouched | static.py | the initial scene, as it is |
| 3dgs-all | static.py | 3DGS (Kerbl et al. 2023) on all photographs of all visits as if nothing changed |
| 3dgs-refit | static.py | 3DGS refitted at each visit to its few photographs |
| 3dgs-dense | static.py | 3DGS fitted anew at each visit to many photographs of it: a bound, not a rival |
| few-shot | few_shot.py | InstantSplat (Fan et al. 2024) |
| deformation | over_time.py | 4DGS (Wu et al. 2024) |
| steps | over_time.py | Neural Scene Chronology (Lin et al. 2023) |
| rigid | system.py | 3DGS-CD (Lu et al. 2025) |
| local | local.py | CL-Splats (Ackermann et al. 2025) |
| expert | expert.py | CL-NeRF (Wu et al. 2023) |
"""
