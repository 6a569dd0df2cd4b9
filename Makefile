# `make` alone lists the targets. Everything is set up in .venv; `make clean` takes it all away again.
SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
MAKEFLAGS += --no-builtin-rules
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.NOTPARALLEL:
.ONESHELL:
.SILENT:

PYTHON ?= python3
SCENARIO ?= subway
RUNS ?= 10
TTOBENCH ?=
PYTEST_ARGS ?=
GUEST_LIMIT_S ?= 1500

RUN_READY := .venv/run.ready
DEV_READY := .venv/dev.ready
COMPILE := .venv/bin/python -m uv pip compile pyproject.toml --universal --generate-hashes --group build \
	--no-header --no-annotate --no-emit-index-url --quiet

.PHONY: help hil test long test-socketcan pil verify prove misra firmware-page yizhuang lines golden pareto figures pictures claims docs lint types lock clean

help: ## list the targets
	sed -nE 's/^([a-z-]+):[^#]*## (.*)/  make \1\t\2/p' Makefile | expand -t 23

hil: $(RUN_READY) ## set up and run the main job: SCENARIO=subway RUNS=10, traces in runs/
	.venv/bin/ato-hil run "$(SCENARIO)" --mode hil --runs "$(RUNS)" --out "runs/$(SCENARIO)" --overwrite
	echo
	echo "Trace: runs/$(SCENARIO)/trace.rrd"
	echo "Open:  .venv/bin/ato-hil view runs/$(SCENARIO)"

test: $(DEV_READY) ## set up and pass the fast tests
	.venv/bin/python -m pytest -n 2 -q -m "not long and not pil and not uml" $(PYTEST_ARGS)

long: $(DEV_READY) ## pass the long tests
	.venv/bin/python -m pytest -q -m "long and not pil and not uml" $(PYTEST_ARGS)

# The guest is slow: what it runs is compiled here first.
test-socketcan: $(DEV_READY) ## pass the tests on SocketCAN, in user-mode Linux, and measure it there
	$(install_guest)
	.venv/bin/ato-hil run tests/uml/short.toml --bus hub:uml --out runs/test-socketcan --overwrite
	.venv/bin/ato-hil export c tests/uml/short.toml --out runs/test-socketcan/ato
	$(MAKE) -s -C examples/linux_can EXPORT="$(CURDIR)/runs/test-socketcan/ato" OUT="$(CURDIR)/runs/test-socketcan"
	.venv/bin/python tests/python_can_tests.py runs/test-socketcan
	.venv/bin/python tests/uml/guest.py --limit $(GUEST_LIMIT_S) \
		.venv/bin/python -m pytest -v -p no:cacheprovider -m uml $(PYTEST_ARGS) tests/uml
	.venv/bin/python tests/uml/guest.py --limit $(GUEST_LIMIT_S) .venv/bin/ato-hil bench \
		--no-sessions --bus socketcan:vcan0 --bus vcan --bus hub:uml

pil: $(DEV_READY) ## pass the tests on emulated microcontrollers; the golden runs among them take an hour
	$(install_emulator)
	.venv/bin/python -m pytest -n 2 -q -rs -m pil $(PYTEST_ARGS)

verify: $(RUN_READY) ## check every promise of the firmware: LAWS="cailc pid", all by default
	.venv/bin/ato-hil verify $(LAWS)

prove: $(RUN_READY) ## prove that no tick of the exported C overflows (Frama-C): LAWS="cailc pid", all by default
	$(call install_tools,frama-c gcc,frama-c-base gcc)
	.venv/bin/ato-hil verify --prove $(LAWS)

misra: $(DEV_READY) ## check that MISRA.md of every law's export lists what cppcheck finds
	$(call install_tools,cppcheck,cppcheck)
	.venv/bin/python -m pytest -q -rs tests/tools/test_misra.py $(PYTEST_ARGS)

firmware-page: $(RUN_READY) ## write docs/firmware.md again: flash, RAM, stack, instructions, coverage of the exported C
	$(call install_tools,arm-none-eabi-gcc qemu-system-arm clang-19 llvm-cov-19,gcc-arm-none-eabi qemu-system-arm clang-19 llvm-19 libclang-rt-19-dev)
	.venv/bin/python -m ato_hil.tools.verify.microcontroller $(LAWS)

yizhuang: $(RUN_READY) ## run the service of docs/yizhuang.md again and write what was measured there
	.venv/bin/python -m ato_hil.tools.reports.service

lines: $(RUN_READY) ## run every line of docs/lines.md again and write what was measured there: TTOBENCH=FOLDER
	.venv/bin/python -m ato_hil.tools.reports.lines "$(TTOBENCH)"

golden: $(RUN_READY) ## write new golden digests (tools/verify/golden.json) and say what changed
	.venv/bin/ato-hil verify --renew-golden $(LAWS)

pareto: $(RUN_READY) ## draw docs/pareto.png again: energy against error in paper 5
	.venv/bin/ato-hil sweep gradient-paper:VI --vary law.L=1,5 --vary law.S=0,0.1,0.25,0.5,1,2,4 --out runs/pareto --overwrite
	cp runs/pareto/pareto.png docs/pareto.png

# Where two lines draw the same figure, the later one stays. The traces take a gigabyte.
figures: $(RUN_READY) ## draw docs/figures again: the papers' figures, from runs of all papers
	rm -rf runs/figures
	run() { .venv/bin/ato-hil run "$${@:2}" --mode sil --out "runs/figures/$$1" >/dev/null; echo "$$1"; }
	draw() { .venv/bin/ato-hil figures "$${@/#/runs/figures/}" --format png --out docs/figures; }
	run subway subway
	draw subway
	for law in cailc pdilc adaptive; do
		run "disturbed-$$law" subway-disturbed --law "$$law"
		run "paper-$$law" subway-paper --law "$$law"
	done
	draw disturbed-cailc disturbed-pdilc disturbed-adaptive
	draw paper-cailc paper-pdilc paper-adaptive
	run th1 crh3-paper
	run th2 crh3-varying
	draw th1 th2
	run poc line-paper
	run svl line-paper --law mtcc-single
	run pid line-pid
	draw poc svl pid
	run afilc crh3-learning-min --runs 100 --no-trace
	run afilc-first crh3-learning-min --runs 1
	run p-ilc crh3-learning-paper --law p-ilc --runs 100 --no-trace
	run p-ilc-first crh3-learning-paper --law p-ilc --runs 2
	draw afilc afilc-first p-ilc p-ilc-first
	cases=(I II III IV V VI VII VIII)
	for case in "$${cases[@]}"; do run "$$case" "gradient-paper:$$case" --no-trace; done
	draw "$${cases[@]}"
	find runs/figures -name trace.rrd -delete

claims: $(RUN_READY) ## measure what the papers claim again, and write it into docs/papers
	mkdir -p runs/claims
	for paper in $$(.venv/bin/python -c "from ato_hil.tools import papers; print(*papers.names())"); do
		.venv/bin/ato-hil claims "$$paper" --json "runs/claims/$$paper.json"
	done
	.venv/bin/python -m ato_hil.tools.cli.docs runs/claims/*.json

docs: $(RUN_READY) ## write docs/messages.md, command-line.md and scenario.md again, from DBC and program
	.venv/bin/python -m ato_hil.tools.cli.docs

# The viewer draws them without a screen, with Vulkan in software: mesa-vulkan-drivers is for this.
pictures: $(RUN_READY) ## draw the screenshots of the viewer in docs/ again
	for law in cailc ailc; do
		.venv/bin/ato-hil run subway --law "$$law" --mode sil --runs 5 --out "runs/pictures/$$law" --overwrite
	done
	.venv/bin/ato-hil run line --mode sil --runs 1 --out runs/pictures/line --overwrite
	.venv/bin/ato-hil view runs/pictures/cailc --screenshot docs/trace.png
	.venv/bin/ato-hil view runs/pictures/cailc --tab learning --screenshot docs/trace-learning.png
	.venv/bin/ato-hil view runs/pictures/cailc --tab bus --screenshot docs/trace-bus.png
	.venv/bin/ato-hil view runs/pictures/line --screenshot docs/trace-line.png
	.venv/bin/ato-hil view --law-compare runs/pictures/cailc runs/pictures/ailc \
		--screenshot docs/trace-compare.png

lint: $(DEV_READY) ## ruff: lint and format
	.venv/bin/python -m ruff check .
	.venv/bin/python -m ruff format --check .

types: $(DEV_READY) ## mypy
	.venv/bin/python -m mypy

lock: $(DEV_READY) ## renew the locks from pyproject.toml (LOCK_ARGS=--upgrade: newest versions)
	$(COMPILE) $(LOCK_ARGS) --output-file requirements.lock
	$(COMPILE) $(LOCK_ARGS) --extra test --extra dev --constraints requirements.lock \
		--output-file requirements-dev.lock

clean: ## remove .venv, runs/ and every cache
	rm -rf .venv build dist runs .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# The files below .venv say that a set-up finished; they are touched last.
$(RUN_READY): pyproject.toml requirements.lock
	$(call set_up,requirements.lock)
	touch $@

$(DEV_READY): pyproject.toml requirements-dev.lock
	$(call set_up,requirements-dev.lock)
	touch $(RUN_READY) $@

define install_emulator
missing=
command -v qemu-system-arm >/dev/null || missing+=" qemu-system-arm"
command -v arm-none-eabi-gcc >/dev/null || missing+=" gcc-arm-none-eabi"
$(call install_missing)
endef

# Packages of Debian where one of these programs is missing.
define install_tools
for tool in $(1); do
	if ! command -v "$$tool" >/dev/null; then
		if [ "$$(id -u)" != 0 ] || ! command -v apt-get >/dev/null; then
			echo "$$tool is missing. Install it, then run make again:" \
				"sudo apt-get install -y $(2)" >&2
			exit 1
		fi
		echo "Installing $(2)"
		apt-get update -qq
		DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $(2) >/dev/null
		break
	fi
done
endef

define install_guest
missing=
command -v linux.uml >/dev/null || missing+=" user-mode-linux"
PATH=$$PATH:/usr/sbin:/sbin command -v insmod >/dev/null || missing+=" kmod"
PATH=$$PATH:/usr/sbin:/sbin command -v ip >/dev/null || missing+=" iproute2"
echo "#include <elf.h>" | gcc -E - >/dev/null 2>&1 || missing+=" gcc libc6-dev"
$(call install_missing, (on x86-64 only))
endef

define install_missing
if [ -n "$$missing" ]; then
	if [ "$$(id -u)" != 0 ] || ! command -v apt-get >/dev/null; then
		echo "Packages of Debian are missing$(1). Install them, then run make again:" \
			"sudo apt-get install -y$$missing" >&2
		exit 1
	fi
	echo "Installing$$missing"
	apt-get update -qq
	DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $$missing >/dev/null
fi
endef

define set_up
if ! .venv/bin/python -m pip --version >/dev/null 2>&1; then
	if ! version=$$("$(PYTHON)" -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null); then
		echo "$(PYTHON) does not run. Name Python 3.11 or newer: make PYTHON=python3.12" >&2
		exit 1
	fi
	if ! "$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))'; then
		echo "ato-hil needs Python 3.11 or newer, and $(PYTHON) is $$version." \
			"Name a newer one: make PYTHON=python3.12" >&2
		exit 1
	fi
	# Debian and Ubuntu keep what venv needs in a package of its own.
	if ! "$(PYTHON)" -c 'import ensurepip' 2>/dev/null; then
		if [ "$$(id -u)" != 0 ] || ! command -v apt-get >/dev/null; then
			echo "Python's venv is missing. Install it, then run make again:" \
				"sudo apt-get install -y python$$version-venv" >&2
			exit 1
		fi
		echo "Installing python$$version-venv"
		apt-get update -qq
		DEBIAN_FRONTEND=noninteractive apt-get install -y -qq "python$$version-venv" >/dev/null
	fi
	echo "Making .venv with Python $$version"
	"$(PYTHON)" -m venv --clear .venv
fi
echo "Installing the packages of $(1) into .venv"
export PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_INPUT=1
PYTHONUNBUFFERED=1 .venv/bin/python -m pip install --no-deps --only-binary :all: --require-hashes \
	--progress-bar off -r $(1) | while IFS= read -r line; do
	case "$$line" in
	*Downloading*MB\)) wheel=$${line#*Downloading }; echo "  $${wheel%%-*} ($${wheel##* (}" ;;
	Installing*) echo "  unpacking" ;;
	esac
done
.venv/bin/python -m pip install --quiet --no-deps --no-build-isolation --editable .
endef
