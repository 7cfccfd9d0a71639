//! Components, spanning trees and centers of graphs of image pairs.

use cv_geometry::{NoSuchNode, PairEdge, PairGraph};
use proptest::prelude::*;

fn graph(nodes: usize, edges: &[(usize, usize, f64)]) -> PairGraph {
    let edges = edges.iter().map(|&(a, b, weight)| PairEdge { a, b, weight }).collect();
    PairGraph::new(nodes, edges).unwrap()
}

#[test]
fn components_are_sorted_by_decreasing_size() {
    let graph = graph(6, &[(4, 0, 9.0), (1, 2, 5.0), (2, 5, 5.0)]);
    assert_eq!(graph.connected_components(), vec![vec![1, 2, 5], vec![0, 4], vec![3]]);
}

#[test]
fn the_spanning_tree_has_the_strongest_edges() {
    let graph = graph(4, &[(0, 1, 10.0), (1, 2, 20.0), (0, 2, 30.0), (2, 3, 1.0)]);
    assert_eq!(graph.maximum_spanning_forest(), vec![2, 1, 3]);
}

#[test]
fn the_center_of_a_chain_does_not_depend_on_the_numbering() {
    // A chain of five images in the order 3 - 0 - 4 - 1 - 2.
    let graph = graph(5, &[(3, 0, 1.0), (4, 1, 1.0), (1, 2, 1.0), (0, 4, 1.0)]);
    let tree = graph.maximum_spanning_forest();
    assert_eq!(graph.center(&tree), Some(4));
    let steps = graph.breadth_first(&tree, 4);
    assert_eq!(steps.iter().map(|s| (s.parent, s.node)).collect::<Vec<_>>(), vec![(4, 1), (4, 0), (1, 2), (0, 3)]);
}

#[test]
fn empty_graphs_and_indices_out_of_range() {
    let empty = graph(0, &[]);
    assert_eq!((empty.connected_components().len(), empty.center(&[])), (0, None));
    let edge = PairEdge { a: 0, b: 3, weight: 1.0 };
    assert_eq!(PairGraph::new(3, vec![edge]), Err(NoSuchNode { edge: 0, a: 0, b: 3, nodes: 3 }));
    assert!(graph(3, &[(0, 1, 1.0)]).breadth_first(&[0, 7], 9).is_empty());
    // The isolated node has eccentricity 0, but is not in the largest tree.
    assert_eq!(graph(3, &[(1, 2, 1.0)]).center(&[0]), Some(1));
}

fn any_graph() -> impl Strategy<Value = PairGraph> {
    (1..7_usize).prop_flat_map(|nodes| {
        let edge = (0..nodes, 0..nodes, 0..50_u32).prop_map(|(a, b, w)| PairEdge { a, b, weight: f64::from(w) });
        proptest::collection::vec(edge, 0..9).prop_map(move |edges| PairGraph::new(nodes, edges).unwrap())
    })
}

/// Shortest paths over edges by Floyd and Warshall.
fn distances(graph: &PairGraph, edges: &[usize]) -> Vec<Vec<usize>> {
    let n = graph.nodes();
    let mut d = vec![vec![usize::MAX / 2; n]; n];
    d.iter_mut().enumerate().for_each(|(i, row)| row[i] = 0);
    for e in edges.iter().map(|&e| graph.edges()[e]).filter(|e| e.a != e.b) {
        d[e.a][e.b] = 1;
        d[e.b][e.a] = 1;
    }
    for k in 0..n {
        for i in 0..n {
            for j in 0..n {
                d[i][j] = d[i][j].min(d[i][k] + d[k][j]);
            }
        }
    }
    d
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    #[test]
    fn nodes_are_in_one_component_if_a_path_connects_them(graph in any_graph()) {
        let all: Vec<usize> = (0..graph.edges().len()).collect();
        let d = distances(&graph, &all);
        let components = graph.connected_components();
        prop_assert_eq!(components.iter().map(Vec::len).sum::<usize>(), graph.nodes());
        for (i, one) in components.iter().enumerate() {
            for (j, two) in components.iter().enumerate() {
                for (a, b) in one.iter().flat_map(|a| two.iter().map(move |b| (*a, *b))) {
                    prop_assert_eq!(d[a][b] < usize::MAX / 2, i == j);
                }
            }
        }
        prop_assert!(components.windows(2).all(|w| w[0].len() >= w[1].len()));
    }

    #[test]
    fn the_spanning_forest_has_the_maximum_weight(graph in any_graph()) {
        let forest = graph.maximum_spanning_forest();
        let total_weight = |edges: &[usize]| edges.iter().map(|&e| graph.edges()[e].weight).sum::<f64>();
        let rank = graph.nodes() - graph.connected_components().len();
        prop_assert_eq!(forest.len(), rank);
        // All spanning forests by exhaustive enumeration.
        for bits in 0..1_u32 << graph.edges().len() {
            let chosen: Vec<usize> = (0..graph.edges().len()).filter(|e| bits >> e & 1 == 1).collect();
            if chosen.len() == rank && distances(&graph, &chosen) .iter().flatten().filter(|d| **d < usize::MAX / 2).count()
                == distances(&graph, &forest).iter().flatten().filter(|d| **d < usize::MAX / 2).count() {
                prop_assert!(total_weight(&chosen) <= total_weight(&forest));
            }
        }
    }

    #[test]
    fn the_center_has_the_minimum_eccentricity_of_the_largest_tree(graph in any_graph()) {
        let tree = graph.maximum_spanning_forest();
        let d = distances(&graph, &tree);
        let reached = |i: usize| d[i].iter().filter(|d| **d < usize::MAX / 2).count();
        let eccentricity = |i: usize| d[i].iter().copied().filter(|d| *d < usize::MAX / 2).max();
        let center = graph.center(&tree).unwrap();
        for i in 0..graph.nodes() {
            prop_assert!(reached(center) >= reached(i));
            prop_assert!(reached(center) > reached(i) || eccentricity(center) <= eccentricity(i));
        }
        for step in graph.breadth_first(&tree, center) {
            prop_assert_eq!(d[center][step.node], d[center][step.parent] + 1);
        }
    }
}
