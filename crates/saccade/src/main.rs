//! The command line. `saccade help` lists the commands.
//!
//! Everything happens in the rooms below; see the README of this crate for its one rule.

#![allow(
    rustdoc::bare_urls,
    rustdoc::broken_intra_doc_links,
    reason = "doc comments here are the help text, in which brackets hold units"
)]

mod arguments;
mod commands;
mod folders;
mod interrupt;
mod looks;
mod open;
mod open_files;
mod progress;
mod report;
mod stitching;

use std::process::ExitCode;

use clap::{Parser, Subcommand};

/// Look into a microscope's volume while it is still being acquired.
#[derive(Parser)]
#[command(version, arg_required_else_help = true)]
struct CommandLine {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    Demo(commands::demo::Demo),
    Simulate(commands::simulate::Simulate),
    Ingest(commands::ingest::Ingest),
    Update(commands::update::Update),
    Serve(commands::serve::Serve),
    View(Box<commands::view::View>),
    Render(Box<commands::render::Render>),
    Export(commands::export::Export),
    Check(commands::check::Check),
}

fn main() -> ExitCode {
    // Prints usage errors itself, and ends with 2.
    let CommandLine { command } = CommandLine::parse();
    report::log_to_stderr();
    saccade_archive::tls::provide();
    open_files::raise();
    let runtime = match tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()
    {
        Ok(runtime) => runtime,
        Err(error) => return report::failed(&error.into()),
    };
    let ended = runtime.block_on(async {
        let done = |done: anyhow::Result<()>| done.map(|()| ExitCode::SUCCESS);
        match command {
            Command::Demo(demo) => done(demo.run().await),
            Command::Simulate(simulate) => done(simulate.run().await),
            Command::Ingest(ingest) => ingest.run().await,
            Command::Update(update) => update.run().await,
            Command::Serve(serve) => done(serve.run().await),
            Command::View(view) => done(view.run().await),
            Command::Render(render) => done(render.run().await),
            Command::Export(export) => export.run().await,
            Command::Check(check) => check.run().await,
        }
    });
    // Work on other threads that nobody waits for any more must not keep the program alive.
    runtime.shutdown_background();
    match ended {
        Ok(code) => code,
        Err(error) => report::failed(&error),
    }
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::CommandLine;

    /// Nobody should have to try what happens without an option.
    #[test]
    fn every_default_is_told() {
        let mut all = CommandLine::command();
        all.build();
        let mut seen = 0;
        for command in all.get_subcommands() {
            for option in command
                .get_opts()
                .filter(|option| !option.is_required_set())
            {
                let (command, id) = (command.get_name(), option.get_id());
                let help = option
                    .get_help()
                    .map(ToString::to_string)
                    .unwrap_or_default();
                let told = help.contains("[default: ") || !option.get_default_values().is_empty();
                // `simulate` wants to be told either.
                let wanted = (command, id.as_str()) == ("simulate", "input");
                assert!(told || wanted, "{command} --{id}: {help}");
                seen += 1;
            }
        }
        assert!(seen > 20, "only {seen} options");
    }
}
