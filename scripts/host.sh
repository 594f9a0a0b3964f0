#!/usr/bin/env bash
# What the host must offer, checked with a plain message before a long build starts.
#
#   host.sh python [NAME]   prints a Python >= 3.11 that can make virtual environments
#   host.sh rust            cargo and a C compiler
#   host.sh lint            rustfmt and clippy
#
# A missing Debian package is installed when we are root and apt-get is there; otherwise the message names it.
set -euo pipefail

fail() {
    echo "nightfix: $*" >&2
    exit 1
}

# install_package PACKAGE WHY
install_package() {
    if [[ $EUID -eq 0 ]] && command -v apt-get >/dev/null; then
        echo "nightfix: installing the Debian package $1 ($2)" >&2
        export DEBIAN_FRONTEND=noninteractive
        { apt-get -qq update && apt-get -qq install -y --no-install-recommends "$1"; } >&2 && return
    fi
    fail "$2 is missing. On Debian: sudo apt-get install $1"
}

new_enough() {
    command -v "$1" >/dev/null && "$1" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null
}

python() {
    local name
    for name in ${1:-python3.11 python3}; do
        if new_enough "$name"; then
            # Debian splits ensurepip off into python3-venv.
            "$name" -c 'import ensurepip, venv' 2>/dev/null || install_package python3-venv "Python's venv module"
            "$name" -c 'import ensurepip, venv' 2>/dev/null || fail "$name cannot make virtual environments"
            "$name" -c 'import sys; print(sys.executable)'
            return
        fi
    done
    fail "Python 3.11 or newer is needed, found $(python3 --version 2>&1 || true); name one with: make PYTHON=/path/to/python3.11"
}

rust() {
    command -v "${CARGO:-cargo}" >/dev/null || fail "cargo is missing: install a Rust toolchain (1.92 or newer), see https://rustup.rs"
    command -v cc >/dev/null || install_package gcc "a C compiler"
    command -v cc >/dev/null || fail "a C compiler (cc) is missing"
}

lint() {
    rust
    local component
    for component in fmt clippy; do
        "${CARGO:-cargo}" "$component" --version >/dev/null 2>&1 && continue
        # rustfmt and clippy are optional parts of a toolchain; rustup can add them.
        command -v rustup >/dev/null && rustup component add "${component/fmt/rustfmt}" && continue
        fail "cargo $component is missing; with rustup: rustup component add ${component/fmt/rustfmt}"
    done
}

case "${1:-}" in
    python) python "${2:-}" ;;
    rust) rust ;;
    lint) lint ;;
    *) fail "usage: host.sh python [NAME] | rust | lint" ;;
esac
