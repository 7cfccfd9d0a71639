//! Why an adjustment cannot be done.

/// Why a problem cannot be stated, solved or have its covariance computed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum AdjustError {
    /// The values of a group are not a whole number of blocks.
    #[error("{group}: {got} numbers are not a whole number of blocks of {block} numbers")]
    Length {
        /// Name of the group.
        group: String,
        /// Numbers given.
        got: usize,
        /// Numbers in a block.
        block: usize,
    },
    /// A block has no, or too many, degrees of freedom.
    #[error("{group}: blocks have {got} degrees of freedom, possible are 1 to {most}")]
    Size {
        /// Name of the group.
        group: String,
        /// Degrees of freedom of a block.
        got: usize,
        /// The most there may be: 64, of a group that is eliminated 6.
        most: usize,
    },
    /// A residual was written for blocks of other sizes.
    #[error("{residuals}: expects blocks with {expected} degrees of freedom where those of {group} have {got}")]
    Dimension {
        /// Name of the residuals.
        residuals: String,
        /// Name of the group of blocks.
        group: String,
        /// Degrees of freedom the residual has derivatives by.
        expected: usize,
        /// Degrees of freedom of a block.
        got: usize,
    },
    /// A block, a parameter of one, or a group is named that there is not.
    #[error("{name}: there is no number {index}, there are {len}")]
    Index {
        /// What is short of it.
        name: String,
        /// What was asked for.
        index: usize,
        /// How many there are.
        len: usize,
    },
    /// A residual depends on two blocks of the eliminated group.
    #[error("{residuals}: a residual may depend on one block of the eliminated group only")]
    TwoEliminated {
        /// Name of the residuals.
        residuals: String,
    },
    /// There is no residual.
    #[error("there are no residuals")]
    NoResiduals,
    /// A parameter is NaN or infinite at the start.
    #[error("{group} {block} is not finite at the start")]
    NotFinite {
        /// Name of the group.
        group: String,
        /// Number of the block.
        block: usize,
    },
    /// A residual is not defined or not finite at the start.
    #[error("{residuals} {item} is not defined at the start")]
    Undefined {
        /// Name of the residuals.
        residuals: String,
        /// Number of the residual.
        item: usize,
    },
    /// The residuals do not determine a block: nothing observes it, or the coordinate system is free.
    #[error("{group} {block} is not determined by the residuals")]
    RankDeficient {
        /// Name of the group.
        group: String,
        /// Number of the block: of several that are free together, the one that moves most.
        block: usize,
    },
}
