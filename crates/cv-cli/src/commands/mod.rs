//! One file per subcommand.
//!
//! To add one, write `NAME.rs` with an `Args` struct that implements [`Run`], and add one line to the list below:
//!
//! ```ignore
//! /// What the command does, in one line: the first line of its help.
//! #[derive(Debug, clap::Args)]
//! #[command(after_help = "Examples:\n  cv shrink photo.jpg -o small.png")]
//! pub(crate) struct Args {
//!     /// The photograph.
//!     image: PathBuf,
//!     /// Where to write the result.
//!     #[arg(short, long)]
//!     output: PathBuf,
//! }
//!
//! impl Run for Args {
//!     // Checked before `run`: the folder is there and can be written to, no file is named twice.
//!     fn outputs(&self) -> Vec<&Path> {
//!         vec![&self.output]
//!     }
//!
//!     fn run(self, context: &Context) -> Result<Outcome, Failure> {
//!         let image = cv_io::read_rgb(&self.image)?; // any error becomes a Failure: exit code 1
//!         let mut options = ShrinkOptions::default();
//!         if let Some(seed) = context.seed {
//!             options.seed = seed; // --seed; --threads has been applied already
//!         }
//!         let result = cv_pipeline::shrink(image.view(), &options, context) // `&Context` is the `&dyn Progress`
//!             .advice("take a larger photograph")?; // becomes "; try: take a larger photograph"
//!         cv_io::write_png(&self.output, result.image.view())?; // whole or not at all
//!         context.report(|| html_of(&result))?; // called and written only under --report DIR
//!         Ok(Outcome::new(result.stages) // `seconds`, `threads` and `version` are added by the frame
//!             .with("width", result.image.width())
//!             .summary(format!("{} px wide", result.image.width())))
//!     }
//! }
//! ```
//!
//! Nothing else prints: stdout carries the one JSON object of `--json`, stderr the bar, [`Context::note`],
//! [`Context::warn`] and the outcome's summary. Wrong usage that clap cannot see is `Failure::usage(..)`: exit code 2.

use crate::common::{Context, Failure, Outcome, Run};

/// Declares the modules and the enum of subcommands, and routes to them.
macro_rules! commands {
    ($($variant:ident($module:ident)),* $(,)?) => {
        $(mod $module;)*

        #[derive(clap::Subcommand)]
        pub(crate) enum Command {
            $($variant(Box<$module::Args>),)*
        }

        impl Command {
            /// Checks the outputs, then runs the command.
            pub(crate) fn run(self, context: &Context) -> Result<Outcome, Failure> {
                match self {
                    $(Self::$variant(args) => {
                        crate::common::check_outputs(&args.outputs())?;
                        (*args).run(context)
                    })*
                }
            }
        }
    };
}

commands! {
    Demo(demo),
    Segment(segment),
    Panorama(panorama),
    Match(match_),
    Estimate(estimate),
    Reconstruct(reconstruct),
    Depth(depth),
    Rectify(rectify),
    Eval(eval),
    Completions(completions),
    Man(man),
}
