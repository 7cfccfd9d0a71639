//! One file per subcommand.
//!
//! To add one, write `NAME.rs` with an `Args` struct that implements [`Run`], declare it here, and add one line to the
//! list of subcommands at the end:
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
//!     /// How to average. (An enum of the library; its names are beside it, in `cv_core::named!`.)
//!     #[arg(long, value_parser = named::<Filter>(), default_value_t = ShrinkOptions::default().filter)]
//!     filter: Filter,
//! }
//!
//! impl Run for Args {
//!     // Checked before `run`: the extension is that of a format, the folder can be created and written to, nothing is named twice.
//!     fn outputs(&self) -> Vec<Output<'_>> {
//!         vec![Output::File(&self.output, PNG)]
//!     }
//!
//!     // Numbered by the progress bar: `frame/steps.rs`.
//!     fn steps(&self) -> Vec<Step> {
//!         vec![steps::READ, steps::SHRINK]
//!     }
//!
//!     // Global options without effect are refused.
//!     fn has_no_use_for(&self) -> &'static [Global] {
//!         &[Global::Seed]
//!     }
//!
//!     fn run(self, context: &Context) -> Result<Outcome, Failure> {
//!         let image = cv_io::read_rgb(&self.image)?; // any error becomes a Failure: exit code 1
//!         let options = ShrinkOptions { filter: self.filter, ..ShrinkOptions::default() }; // --threads has been applied already
//!         let result = cv_pipeline::shrink(image.view(), &options, context) // `&Context` is the `&dyn Progress`
//!             .advice("take a larger photograph")?; // becomes "; try: take a larger photograph"
//!         // Written atomically; the folder is created, and `-` is stdout.
//!         context.write(Output::File(&self.output, PNG), |path| cv_io::write_png(path, result.image.view()))?;
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

use crate::frame::{Context, Failure, Outcome, Run};

mod board;
mod calibrate;
mod calibration;
mod completions;
mod demo;
mod depth;
mod estimate;
mod eval;
mod man;
mod match_;
mod panorama;
mod reconstruct;
mod rectify;
mod segment;
mod sfm;
mod undistort;

/// Parses a width and a height in pixels, each from 1 to 16384, such as `640x480`; for `value_parser`.
fn size(text: &str) -> Result<(usize, usize), String> {
    let (w, h) = text.split_once(['x', '×']).ok_or("give width and height as 1280x960")?;
    match (w.parse(), h.parse()) {
        (Ok(w), Ok(h)) if (1..=16_384).contains(&w) && (1..=16_384).contains(&h) => Ok((w, h)),
        _ => Err("width and height are whole numbers from 1 to 16384".to_owned()),
    }
}

/// Defines the enum of subcommands and dispatches to them. The modules are declared outside, since rustfmt does not find files in
/// macros.
macro_rules! subcommands {
    ($($variant:ident($args:ty)),* $(,)?) => {
        #[derive(clap::Subcommand)]
        pub(crate) enum Command {
            $($variant(Box<$args>),)*
        }

        impl Command {
            /// Checks the global options and the outputs, then runs the command.
            pub(crate) fn run(self, context: &Context) -> Result<Outcome, Failure> {
                match self {
                    $(Self::$variant(args) => {
                        context.refuse(args.has_no_use_for())?;
                        context.check(&args.outputs())?;
                        context.expect(args.steps());
                        (*args).run(context)
                    })*
                }
            }
        }
    };
}

// In the order of `cv --help`.
subcommands! {
    Demo(demo::Args),
    Segment(segment::Args),
    Panorama(panorama::Args),
    Match(match_::Args),
    Estimate(estimate::Args),
    Reconstruct(reconstruct::Args),
    Sfm(sfm::Args),
    Depth(depth::Args),
    Rectify(rectify::Args),
    Board(board::Args),
    Calibrate(calibrate::Args),
    Calibration(calibration::Args),
    Undistort(undistort::Args),
    Eval(eval::Args),
    Completions(completions::Args),
    Man(man::Args),
}
