#!/usr/bin/env bash
# Make a virtual environment with tk and all that its development needs: setup.sh VENV
# Only what some tests need: setup.sh --browser (those of the report), setup.sh --display (those of tk view),
# setup.sh --ffmpeg (one of tk sync)
# On Debian and Ubuntu, missing system packages are installed if we are root and named if we are not.
set -euo pipefail
cd "$(dirname "$0")/.."
venv=${1:?usage: scripts/setup.sh VENV | --browser | --display | --ffmpeg}

say() { echo "setup: $*" >&2; }
die() { say "$*"; exit 1; }

install_packages() { # packages...
  if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    say "installing $*"
    export DEBIAN_FRONTEND=noninteractive
    { apt-get update -qq && apt-get install -y -qq --no-install-recommends "$@"; } </dev/null >&2 ||
      die "apt-get could not install: $*"
  else
    die "system packages are missing; install them and run again: sudo apt-get install $*"
  fi
}

for_tests() { # what is missing, packages...
  local what=$1
  shift
  if [ "$(id -u)" = 0 ]; then
    install_packages "$@"
  else
    say "no $what: the tests that need it will be skipped; sudo apt-get install $*"
  fi
}

case $venv in
  --browser)
    command -v chromium chromium-browser google-chrome >/dev/null || for_tests Chromium chromium
    exit
    ;;
  --display) # an X server that draws into memory; brings OpenGL without a graphics card
    command -v Xvfb >/dev/null || for_tests Xvfb xvfb
    exit
    ;;
  --ffmpeg) # the command, which cuts a file between two key frames
    command -v ffmpeg >/dev/null || for_tests FFmpeg ffmpeg
    exit
    ;;
esac

suitable() { # python: is it one that Taichi has wheels for?
  "$1" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))' >/dev/null 2>&1
}

find_python() {
  local candidate
  for candidate in ${PYTHON:-python3 python3.12 python3.11 python3.13 python3.10}; do
    if suitable "$candidate"; then
      command -v "$candidate"
      return
    fi
  done
  return 1
}

# --- an interpreter
if ! python=$(find_python); then
  [ -z "${PYTHON:-}" ] || die "PYTHON=$PYTHON is not a Python 3.10 to 3.13"
  command -v python3 >/dev/null && die "$(python3 --version) does not suit: Python 3.10 to 3.13 is needed; install one, or name it: make PYTHON=..."
  install_packages python3 python3-venv
  python=$(find_python) || die "Python 3.10 to 3.13 is needed, and this system's python3 is another; name one: make PYTHON=..."
fi

# Debian splits venv's pip off the interpreter
missing=()
version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
"$python" -c 'import ensurepip, venv' >/dev/null 2>&1 || missing+=("python$version-venv")

# --- what Open3D's wheel links to and does not bring along
if [ "$(uname -s)" = Linux ]; then
  libraries=$(PATH=$PATH:/sbin:/usr/sbin ldconfig -p 2>/dev/null || true)
  while read -r library package; do
    case $libraries in *"$library "*) ;; *) missing+=("$package") ;; esac
  done <<'END'
libEGL.so.1 libegl1
libGL.so.1 libgl1
libX11.so.6 libx11-6
libgomp.so.1 libgomp1
libidn2.so.0 libidn2-0
libudev.so.1 libudev1
libusb-1.0.so.0 libusb-1.0-0
END
fi
[ ${#missing[@]} = 0 ] || install_packages "${missing[@]}"

# --- the environment; one of another interpreter, or half made, is made anew
if ! "$venv/bin/python" -m pip --version >/dev/null 2>&1 || ! suitable "$venv/bin/python"; then
  say "making $venv with $("$python" --version)"
  "$python" -m venv --clear "$venv"
fi
say "installing tk and what it and its tests need into $venv, 1.7 GB; this takes some minutes"
# pip's own list is long: name the files of 10 MB and more, and the end of the downloads
PYTHONUNBUFFERED=1 "$venv/bin/python" -m pip install --disable-pip-version-check --progress-bar off --editable '.[dev]' \
  </dev/null | awk '
    /^ *(Downloading|Using cached) / && $NF == "MB)" && substr($(NF - 1), 2) + 0 >= 10 { sub(/.*\//, "", $(NF - 2)); print "setup: " tolower($1) " " $(NF - 2) " " $(NF - 1) " " $NF }
    /^Installing collected packages/ { print "setup: unpacking " NF - 3 " packages" }
    { fflush() }' >&2
