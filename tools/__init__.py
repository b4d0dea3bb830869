"""Programs about the package, not of it: what they answer, and the command that does it.

Run them from the checkout's root, as in ``python -m tools.bench.search --help``. A SCENE is a folder that holds
point_cloud.ply and cameras.json. They print Markdown; most keep their figures with --json, for docs/benchmarks.

How fast, how large, how much memory (``bench``):

=====================  =================================================================================================
bench.encode           run time against error of every stage and variant on every device: what is on the Pareto front?
bench.rasterizer       frames a second, and time against splats, pixels and overlap
bench.pruning          what does pruning keep, against other pruners, and what may its sweeps skip?
bench.refit            what does the re-fit of the colours bring, and what does it take?
bench.fit              how fast are the fit's steps, and how exact its derivatives?
bench.compaction       speed of the compaction, and its error against float64
bench.compact_at       when within the pruning schedule to compact?
bench.decode           how fast does a file decode, by compiled code, NumPy or OpenCL, and in how much memory?
bench.decode_parts     what is the time of a decode made of, part by part?
bench.presets          what does each preset take, by stage and as a whole command, and what does it give?
bench.whole_command    what is the time of a fresh command `encode` made of?
bench.codec            speed, memory and size of the codec alone
bench.search           what does encoding to a size or a PSNR cost, against one plain encode?
bench.virtual_cameras  what does encoding without cameras cost?
bench.viewer           how many pictures a second does the viewer show while a camera moves?
bench.forecast         how far off is what an encode says beforehand of its time and memory?
bench.install          what does an installation take, and where are there wheels?
bench.views_between    what do views between the training views bring, and what do they take?
bench.palettes         how long does a palette of SH coefficients take, and how near does it come?
bench.outputs          what does a file of another format take beyond the encode itself?
bench.needs            what is a scene charged for splats, views and tiles that nobody needs?
bench.busy             how busy is the device during an encode, stage by stage?
bench.kernels          processor time of each kernel, on machines that do other work too
bench.paired           are whole encodes faster or slower than those of another checkout?
bench.memory           host memory of one encode, stage by stage
bench.traffic          what travels to and from the workers of a cluster, and what is it for?
bench.scaling          time and memory against splats, views and workers: with which exponents?
bench.memory_growth    peak memory against splats and views, and whether --memory is obeyed
=====================  =================================================================================================

What a choice costs or brings, against the alternatives (``study``):

=========================  =============================================================================================
study.rate_distortion      size against quality: the curves that other studies compare with
study.ablation             what does each part of the codec contribute?
study.fit                  how far should a scene be pruned before a fit, and what does each part of the fit bring?
study.colour_steps         what do steps of colours that fit each splat bring, part by part?
study.compare_formats      what would people use instead?
study.output_formats       how small are encodes to the formats that viewers open, and what do others read of them?
study.elsewhere            what is left of a scene, with cameras and without, where nobody has photographed it?
study.virtual_views        how many virtual views, how large, how wide, at what time and memory?
study.rates                where do the bits go, and what do they buy?
study.fit_guards           is a file with the fit ever worse than one without: few views, thresholds by hand?
study.photographs          how much nearer to unseen photographs does a fit to others bring a scene and its file?
study.gauss_newton         does Gauss-Newton fit a pruned scene in less time than Adam?
study.antialiasing         what is lost if an antialiased scene is encoded as a classic one?
study.compaction_curves    what does the compaction do to sparsity and pictures?
study.removal_exactness    how far are predicted removal effects from removals in float64?
study.removal_formulas     back to front or prefix sums: which formula of removal effects?
study.frames               which cameras in another frame are found, and what do unseen splats cost?
study.composite_yardstick  the compositing kernel beside a loop in C
study.lens_field           which pinhole view should stand for a distorted photograph?
=========================  =============================================================================================

What happens at the limits (``stress``):

==================  ====================================================================================================
stress.run          every kernel against float64 on the worst inputs: what error is the kernel's own?
stress.platforms    the rasterizer, the metrics and the re-fit on every OpenCL runtime of this machine
stress.simulated    does Oclgrind see a race, an access out of bounds or an uninitialised read in any kernel?
stress.viewer       do the viewer's memory and time stay bounded, however long its cameras move?
stress.fuzz         does any changed file do more than be refused or decode to finite numbers?
stress.guided       the same of files that are changed towards code that none has reached yet (Atheris)
stress.bombs        what do files take that unpack to far more than they are, or claim to?
stress.signals      what is left of a command that is told to end, at any moment?
stress.determinism  does every command write the same bytes the second time?
stress.native       does the compiled decoder touch memory not its own, or differ from NumPy's, on changed files?
==================  ====================================================================================================

What tests and pages are made of (``make``):

====================  ==================================================================================================
make.large_scene      a scene of any size with the statistics of a real one
make.city             copies of trained scenes side by side, any number of splats and views
make.test_data        the excerpts in tests/data
make.release          a wheel and an sdist that are ready for a package index
make.viewer_pictures  the pictures of the viewer in README and docs
make.readme_picture   the picture at the top of the README
make.foreign_files    the excerpt in splat-transform's formats
make.other_tools      some splats in the formats of six tools, and how splat-transform reads them
make.golden_files     files that every later decoder must read to the same values
make.native           the compiled part of the decoder, in the checkout
make.docs             the pages and tables of README and docs that are made from the code (see CONTRIBUTING.md)
make.benchmark_pages  the tables and plots of docs/benchmarks, from the results beside them; which tables are old
make.benchmark_take   results for docs/benchmarks, from what a tool has kept with --json
====================  ==================================================================================================

Shared: :mod:`tools.results` (tables that say what they are of), :mod:`tools.workloads` (scenes, views, repeated work),
:mod:`tools.viewer_tab` (a browser's tab without the browser), :mod:`tools.study.evaluation` (what a candidate loses to
its scene), :mod:`tools.study.curves` (points of several runs as one curve), :mod:`tools.study.pruning_baselines` (the
orders of other pruners), :mod:`tools.stress.cases` (inputs at their worst), :mod:`tools.stress.precise` (what they give
in float64). Tools import the package and its float64 definitions (:mod:`potr_cl.reference`), never the tests; kernels
of their own are given to a :class:`potr_cl.opencl.device.Device` as variants. Their own tests are in tools/tests.
"""
