//! The `nightfix` program: see [`nightfix::cli`].

fn main() -> std::process::ExitCode {
    nightfix::cli::main()
}
