//! Errors of an adjustment.

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
        /// The maximum: 64, or 6 for an eliminated group.
        most: usize,
    },
    /// A residual expects blocks with other degrees of freedom.
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
    /// The index of a group, block or parameter is out of range.
    #[error("{name}: index {index} is out of range, there are {len}")]
    Index {
        /// Name of the group, or `groups`.
        name: String,
        /// The index, from 0.
        index: usize,
        /// Number of elements.
        len: usize,
    },
    /// A residual depends on two blocks of the eliminated group.
    #[error("{residuals}: a residual may depend on one block of the eliminated group only")]
    TwoEliminated {
        /// Name of the residuals.
        residuals: String,
    },
    /// The problem has no residuals.
    #[error("there are no residuals")]
    NoResiduals,
    /// A parameter is NaN or infinite at the start.
    #[error("{group} {block} is not finite at the start")]
    NotFinite {
        /// Name of the group.
        group: String,
        /// Index of the block.
        block: usize,
    },
    /// A residual is not defined or not finite at the start.
    #[error("{residuals} {item} is undefined at the start")]
    Undefined {
        /// Name of the residuals.
        residuals: String,
        /// Index of the residual.
        item: usize,
    },
    /// The residuals do not determine a block: it is not observed, or the gauge is not fixed.
    #[error("{group} {block} is not determined by the residuals")]
    RankDeficient {
        /// Name of the group.
        group: String,
        /// Index of the block: the one with the largest component in the null direction.
        block: usize,
    },
}
